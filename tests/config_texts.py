"""Texts of small swarm.toml files, for tests to begin with."""

from pathlib import Path

FILE = Path("swarm.toml")

THREE = """\
network = "lab"
[[robots]]
name = "r0"
link = "tcp:10.0.0.1:7447"
[[robots]]
name = "r1"
link = "tcp:10.0.0.2:7447"
[[robots]]
name = "r2"
link = "tcp:10.0.0.3:7447"
[topology]
shape = "line"
[mesh]
insecure = true
"""

ONE = 'network = "lab"\n[[robots]]\nname = "r0"\n'


def radio(count, topology):
    robots = "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "B8:27:EB:00:00:{i:02X}"\n' for i in range(count))
    return f'network = "lab"\n{robots}[topology]\n{topology}\n[mesh]\ninsecure = true\n'


def swap(old, new, text=THREE):
    assert old in text
    return text.replace(old, new)
