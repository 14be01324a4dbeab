"""What a page started with `--control` may do: to simulated robots, and to real ones over ssh."""
