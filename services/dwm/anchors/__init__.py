"""The places of anchors, from the distances between them."""
