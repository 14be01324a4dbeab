"""Recordings of runs: written by the processes of a run as it goes, read back as one (docs/reference/recordings.md)."""
