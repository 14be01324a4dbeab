"""The dwm process of one robot: `python -m services.dwm`."""

from services.dwm import replay, serial_port
from services.dwm.source import Replay, parse_source
from swarm.recordings import read_recording
from swarm.service import Service, run


def main() -> None:
    """Publish ranges and pose from the configured source until told to stop."""
    with Service("dwm") as service:
        source = parse_source(service.config, service.robot)
        if isinstance(source, Replay):
            index = service.config.names.index(service.robot)
            replay.serve(service, read_recording(source.directory, index))
        else:
            serial_port.serve(service, source.path)


if __name__ == "__main__":
    run(main)
