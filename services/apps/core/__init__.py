"""The decisions of the app host, and the computations of the built-in apps that move and blink: no IO, `now` is an
argument."""
