"""The app host and the built-in apps."""
