"""What decides in the app host, and what the built-in apps that move and blink compute: no IO, `now` is an argument."""
