"""The dwm process of one robot: `python -m services.dwm`."""

from services.dwm import balancer_block, external, replay, serial_port
from swarm.config import Config
from swarm.process.service import Service, run
from swarm.recording.thesis_ranges import read_recording

BALANCER, REPLAY, BUS = "balancer", "replay", "bus"
"""Kinds of sources besides a DWM1001 in generic mode at a serial port: one that is wired to the ATmega32U4, and whose
reports come from the balancer; recordings, one file for each robot by its number in the config; another process on the
robot's bus that gives poses or ranges, as a motion capture system."""


def source_of(config: Config, robot: str) -> tuple[str, str]:
    """Return the kind of the source of `robot` as `[dwm] source` says it, and its port, folder or key, in which
    `{robot}` stands for the name."""
    kind, _, rest = config.dwm.source.partition(":")
    return kind, rest.replace("{robot}", robot)


def main() -> None:
    """Publish ranges and pose from the configured source until told to stop."""
    with Service("dwm") as service:
        config, robot = service.config, service.robot
        kind, rest = source_of(config, robot)
        path = config.path.parent / rest  # a relative path starts at the config's folder
        if kind == REPLAY:
            replay.serve(service, read_recording(path, config.names.index(robot)))
        elif kind == BALANCER:
            balancer_block.serve(service)
        elif kind == BUS:
            external.serve(service, rest)
        else:
            serial_port.serve(service, path)


if __name__ == "__main__":
    run(main, "Run the UWB service of this robot, which reads the DWM1001 module and publishes ranges and the pose.")
