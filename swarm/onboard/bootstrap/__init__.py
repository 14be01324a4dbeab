"""What runs on the robots, sent over ssh by `laptop.fleet.ssh.remote`: the standard library alone, from Python 3.9 on.

Pairing has jeepney besides, which is sent along. A robot that is fresh, or too old (Bullseye), must still be able to
say so. Main modules have `main(request, tell)`.
"""
