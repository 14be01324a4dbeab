"""The room of the robots that are booted: an anchor in each corner, on the floor."""

ANCHORS = """[[anchors]]
address = "C933"
x = 0.0
y = 0.0
z = 0.0
[[anchors]]
address = "C584"
x = 3.0
y = 0.0
z = 0.0
[[anchors]]
address = "D32F"
x = 0.0
y = 3.0
z = 0.0
[[anchors]]
address = "0C1D"
x = 3.0
y = 3.0
z = 0.0
"""
