"""Pictures of recorded runs, as a paper would print them. Nothing here imports matplotlib: figures are handed in."""
