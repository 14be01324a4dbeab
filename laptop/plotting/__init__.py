"""Pictures of recorded runs, as a paper would print them. Nothing here imports matplotlib before a picture is drawn."""
