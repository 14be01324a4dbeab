"""Files of robots on the laptop: recordings and journals that are fetched, calibrations both ways."""
