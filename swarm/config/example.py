"""The commented `swarm.toml` that `swarm config --example` prints. The tests load it and miss no entry in it."""

EXAMPLE = """\
# swarm.toml describes the whole swarm. Every robot has the same file, in /etc/swarm. A laptop looks for it
# in the working directory, ~/.config/swarm and /etc/swarm; the variable SWARM_CONFIG names another place.
# Each robot knows which one it is by its host name or the variable SWARM_ROBOT.
# Units are SI: m, rad, s, Hz. Check a changed file with: swarm config check swarm.toml

network = "lab"            # robots of another network are refused
# topology = "auto"        # in place of the table [topology]: robots find their neighbours themselves

# ---- Robots. Names: a lower-case letter, then up to 15 lower-case letters, digits, _ or -.

[[robots]]
name = "r0"
board = "zero2w"                    # zero2w or pi4: sets the body's mass
bluetooth = "B8:27:EB:00:00:10"     # of the Pi's adapter; without it swarm pair writes it here

[[robots]]
name = "r1"
uwb = "DE01"                        # address of its DWM1001: swarm dwm info
uwb_role = "tag"                    # tag (finds its place) or anchor (other robots' tags range to it)
i2c_clock = 100                     # kHz of the I2C bus; 400 was tried in simulation only
bluetooth = "B8:27:EB:00:00:11"

[[robots]]
name = "r2"
bluetooth = "B8:27:EB:00:00:12"

[[robots]]
name = "r3"
bluetooth = "B8:27:EB:00:00:13"

[[robots]]
name = "r4"
board = "pi4"
host = "pi@192.168.1.14"            # how ssh reaches it from a laptop, where that is not by its name
bluetooth = "B8:27:EB:00:00:14"

[[robots]]
name = "r5"
bluetooth = "B8:27:EB:00:00:15"
# How the others reach a robot where that is not Bluetooth; a simulation fills in sim:SOCKET by itself.
# link = "tcp:192.168.1.15:7447"

# ---- Topology: which robots are neighbours. Exactly one of shape, edges or matrix; connected, links hold
# both ways, at most seven Bluetooth links a robot. A link counts as Bluetooth when either end has no `link`.
# `swarm mesh topology set` changes it while the swarm runs; another table here, on all robots, undoes that.

[topology]
shape = "thesis-d"         # line, loop, full, thesis-d (six robots) or random:SEED
# edges = [["r0", "r1"], ["r1", "r2"], ["r2", "r3"], ["r3", "r4"], ["r4", "r5"]]
# matrix = [                # rows and columns in the order of the robots
#   [0, 1, 0, 1, 1, 1],
#   [1, 0, 1, 0, 0, 0],
#   [0, 1, 0, 1, 0, 1],
#   [1, 0, 1, 0, 1, 0],
#   [1, 0, 0, 1, 0, 1],
#   [1, 0, 1, 0, 1, 0],
# ]

# ---- Mesh: the links between robots.

[mesh]
# key = "/etc/swarm/key"   # a robot with this key is a member: `swarm key new`, then copy it to all robots
# insecure = true          # in place of a key: anyone in reach can join; `swarm sim` needs neither
# listen = "0.0.0.0:7447"  # where tcp: neighbours may call; nothing listens on the network without it
heartbeat = 0.5            # s between heartbeats
suspect = 1.5              # s of silence until a link is suspect,
dead = 3.0                 # and until it is closed and dialled anew; both grow with a slow link's round trips
handshake = 8.0            # s that each half of a handshake may take; doubled after each one not answered
patience = 60.0            # s that none of these exceeds, however slow a link is
metric = "hops"            # the shortest way is that of fewest links, or of least measured "time"
links = "auto"             # which links carry the topology: "graph": its own; "star": the first robot here
                           # calls all others and forwards their messages; "tree": several do so, for more
                           # than eight; "auto": star or tree on Bluetooth, graph elsewhere, and the hub
                           # of a star by measured round trips
rfcomm_channel = 1         # of Bluetooth, 1 to 30, the same on every robot (bluetoothd -C holds 8)
rfcomm_encrypt = false     # true: Bluetooth encrypts the links; needs bluetoothd, pairing without questions

# ---- Relay: which keys of its own a robot sends to others, where they appear under the same name.
# Messages of apps to their neighbours (swarm/{self}/app/*/sync/..., latest/...) need no rule here.
# {self} is the robot's own name; {peer}, as a chunk, the name of the robot the key goes to.

[[relay]]
keys = "swarm/{self}/dwm/pose"
overlay = "neighbours"     # one hop, or "flood" (every robot), or "unicast" (the robot {peer}, anywhere)
priority = "bulk"          # control, sync or bulk
queue = "latest"           # latest (a newer value replaces a waiting one) or all (in order, none left out)
max_rate = 2.0             # Hz for each key, only for "latest"; without it as published

# ---- Anchors: UWB modules at known places. The address is the short one, as the module prints it.

[[anchors]]
address = "D001"
x = 0.0
y = 0.0
z = 0.0

[[anchors]]
address = "D002"
x = 1.94
y = 0.0

[[anchors]]
address = "D003"
x = 1.00
y = 1.94

# ---- Software of every robot, beside ours. swarm deploy brings it; robots need no internet.

# [robot]
# packages = ["numpy"]     # for apps that import it: 15 MB more for each such app

# ---- UWB module of every robot: source, calibration, filter.

[dwm]
source = "serial:/dev/serial0"  # or balancer (wired to the ATmega), bus:KEY, replay:DIR; {robot}: its name
target = "C933"            # address of the module that is the target
rate = 10.0                # Hz, at most 10
filter = "auto"            # pose by ekf (needs odometry), multilateration or average; auto: ekf or average
window = 5                 # moving average of ranges over so many measurements; 1 = off
position_window = 5        # the same for places
latency = 0.06             # s from a measurement until its report is read
height = 0.0               # of the robots' antennas in the frame of the anchors, m
lever = 0.0                # from the axle up to the antenna, m
calibration = "calibration/{robot}.toml"    # made by `swarm calibrate`; goes before the two tables below

[dwm.filters]              # of single robots
r5 = "average"

[dwm.distance]             # calibrated distance = gain * measured + offset
gain = 0.946976
offset = -0.05964849       # m

[dwm.position]             # calibrated position = matrix * measured + offset
matrix = [[0.93538932, 0.00353817], [-0.01071457, 0.94470965]]
offset = [0.046239576, 0.050861534]    # m

# ---- Body: parameters of the robots' mechanics.

[body]
wheel_radius = 0.040       # m
gear_ratio = 110.25        # motor turns for one turn of a wheel
track = 0.11               # m between the wheels
trim = 0.0                 # tilt at which it balances, from the upright of the IMU, rad
# payload = 0.05           # kg of Pi, UWB module and display; without it as the robot's board says
payload_height = 0.071     # m above the axle: its centre of mass

[body.robots.r4]           # what is different in one robot
trim = 0.03

# ---- Balancing: controller, limits of driving, and of the battery. Single robots as in [body.robots.NAME].

[balancing]
controller = "lqr"         # computed from the body above; or "pololu" or "thesis": Pololu's algorithm
max_speed = 0.5            # m/s, at most 0.6
max_turn_rate = 3.0        # rad/s, at most 6
acceleration = 0.5         # m/s^2, at most 1
turn_acceleration = 6.0    # rad/s^2, at most 20
battery_warning = 6.6      # V: a warning,
battery_limit = 6.0        # V: and the robot lies down
flip_left_motor = false    # true if its wires are the other way round
flip_right_motor = false

[balancing.robots.r5]
controller = "pololu"

# ---- Apps: parameters by name, for all robots and for single ones on top. Numbers, true or false, texts, and
# lists of numbers. A parameter named like a field of the app's state sets its starting value.

[apps.consensus]
algorithm = "metropolis"   # or "thesis"
value = 0.5

[apps.consensus.robots.r5]
value = 5.0

[apps.localization]
algorithm = "info"         # or "thesis"

# ---- Recordings: what robots keep of their runs until they are fetched.

[recordings]
budget = 2_000_000_000     # bytes of a robot's disk; beyond, the oldest finished runs are deleted

# ---- Simulation: where things start; only `swarm sim` reads it. Robots without a place get one.

[simulation]
target = [0.5, 1.0]        # m
target_velocity = [0.0, 0.0]    # m/s, from the first iteration of all robots on
# scl = 100000             # Hz of the simulated I2C bus; as a real robot has it: swarm sim --like REPORT
# battery = 7.4            # V
# gyro_noise = 0.0012      # rad/s
# acceleration_noise = 0.009    # m/s^2
# range_noise = 0.04       # m, of UWB ranges in line of sight

[simulation.places]        # x in m, y in m, heading in rad
r0 = [0.5, 1.5, 0.0]
r1 = [1.0, 0.5, 1.57]
"""
