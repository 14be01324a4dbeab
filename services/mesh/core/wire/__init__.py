"""Bytes: frames of a connection, packets of the overlays, keys and tags that make frames authentic.

Everything else of the core may use it; it imports nothing of the core. Kinds of packets that one module alone sends are
made there (`routing.topology`, `overlays.stop`, `bulk.pieces`), with the reader of this folder.
"""
