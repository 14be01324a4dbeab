"""Messages that are kept until their end: numbered ones between two robots, and large ones, fetched piece by piece.

`numbered` is the sender's and the receiver's bookkeeping, `transfers` offers large messages of unicast, `exchange`
fetches large messages of unicast and flood, `pieces` has their packets and decides how many are asked for at a time.
Users: `overlays`.
"""
