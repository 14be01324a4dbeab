"""What an app keeps in files: snapshots, votes, its claim on its name, and its recording."""
