"""The code for a laptop: command line, fleet over ssh, live page, plots. Robots do not carry it."""
