"""The dwm process of one robot: `python -m services.dwm`."""

from services.dwm import balancer_block, external, replay, serial_port
from services.dwm.source import BalancerSource, BusSource, Replay, parse_source
from swarm.process.service import Service, run
from swarm.recording.thesis_ranges import read_recording


def main() -> None:
    """Publish ranges and pose from the configured source until told to stop."""
    with Service("dwm") as service:
        source = parse_source(service.config, service.robot)
        if isinstance(source, Replay):
            index = service.config.names.index(service.robot)
            replay.serve(service, read_recording(source.directory, index))
        elif isinstance(source, BalancerSource):
            balancer_block.serve(service)
        elif isinstance(source, BusSource):
            external.serve(service, source.key)
        else:
            serial_port.serve(service, source.path)


if __name__ == "__main__":
    run(main, "Run the UWB service of this robot, which reads the DWM1001 module and publishes ranges and the pose.")
