"""The programs that `laptop.fleet.ssh.remote` sends to robots over ssh: the standard library alone, from Python 3.9 on.

Pairing has jeepney besides, which is sent along. A robot that is fresh, or too old (Bullseye), must still be able to
say so. Main modules have `main(request, tell)`.
"""
