"""What apps reach: consensus and localization beside the thesis, and apps that move bodies together."""
