"""One connection with a neighbour, from the call to its end, and what a robot keeps of that neighbour.

`session` is one connection; it owns an `outbox` (what waits, by class), a window and fragments (`flow`), heartbeats
(`round_trips`) and follows the mesh `clock`. `calls` says who calls whom and who may call, `neighbour` keeps what lasts
longer than a connection. Users: `connections` and `node`; `bulk` uses `round_trips`, `routing` uses `calls`.
"""
