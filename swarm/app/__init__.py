"""The app API: what the author of a distributed algorithm imports and sees."""
