"""The slot radio beside recordings, and swarms that compute over it."""
