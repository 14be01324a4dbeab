"""The files of an app: snapshots, votes, the claim on its name, and its recording."""
