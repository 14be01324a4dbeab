"""What decides in the app host: no IO, `now` is an argument."""
