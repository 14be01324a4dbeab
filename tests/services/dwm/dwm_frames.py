"""Frames that the tests of this folder share."""

from services.dwm.core.module.tlv import AnchorRange, Location, Position

# The example of the API guide (thesis fig. 2.6): the position is printed there in full, of the ranges only
# their count and length; address C933 and what follows it are ours.
POSITION_BYTES = bytes.fromhex("4b0a0000 1f040000 9c0e0000 64")
GOLDEN = bytes.fromhex(
    "400100 410d 4b0a0000 1f040000 9c0e0000 64 4951 04"
    "33c9 e8030000 64 f4010000 e8030000 00000000 64"
    "01d0 d0070000 63 00000000 00000000 00000000 64"
    "02d0 39050000 00 94070000 00000000 00000000 64"
    "03d0 01000000 32 e8030000 94070000 ffffffff 00"
)
LOCATION = Location(
    Position(2.635, 1.055, 3.740, 100),
    (
        AnchorRange("C933", 1.0, 100, Position(0.5, 1.0, 0.0, 100)),
        AnchorRange("D001", 2.0, 99, Position(0.0, 0.0, 0.0, 100)),
        AnchorRange("D002", 1.337, 0, Position(1.94, 0.0, 0.0, 100)),
        AnchorRange("D003", 0.001, 50, Position(1.0, 1.94, -0.001, 0)),
    ),
)
EMPTY = Location(Position(0.0, 0.0, 0.0, 0), ())
