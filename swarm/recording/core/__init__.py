"""Bytes of recordings, without IO: the MCAP container, JSON texts and schemas."""
