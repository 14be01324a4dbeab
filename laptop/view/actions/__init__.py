"""The actions of a page started with `--control`: on simulated robots, and on real ones over ssh."""
