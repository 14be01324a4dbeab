"""The transports of one robot: where it listens, and how it reaches the neighbours that it dials."""

from pathlib import Path

from services.mesh import monikers
from services.mesh.core.session import Local
from services.mesh.links import sim, tcp
from services.mesh.links.pipe import Pipe
from services.mesh.runner import Listener
from swarm.config import Config
from swarm.errors import ConfigError


class Network:
    """Everything this robot needs to meet its neighbours; `directory` is its runtime directory."""

    def __init__(self, config: Config, local: Local, directory: Path) -> None:
        self._addresses = {
            peer: monikers.of_robot(config.robot(peer)) for peer, we_dial in local.dials.items() if we_dial
        }
        callers = [peer for peer, we_dial in local.dials.items() if not we_dial]
        own = monikers.of_robot(config.robot(local.robot)) if callers else None
        listen = config.mesh.listen
        near = [monikers.of_robot(config.robot(peer)) for peer in callers]
        hosts = {moniker.host for moniker in near if isinstance(moniker, monikers.Tcp)}
        if isinstance(own, monikers.Tcp) and listen is None:
            raise ConfigError(
                f"{config.path}: [mesh] listen: {', '.join(callers)} will dial {local.robot} over tcp:, "
                f'so say where it listens, for example "0.0.0.0:{own.port}"'
            )
        simulated = any(isinstance(each, monikers.Sim) for each in (own, *self._addresses.values()))
        self._air = sim.Air(local.robot, directory) if simulated else None
        self.listeners: list[Listener] = []
        try:
            if isinstance(own, monikers.Sim) and self._air is not None:
                self.listeners.append(sim.Listener(own.path, self._air))
            if listen is not None:
                self.listeners.append(tcp.Listener(monikers.parse_address(listen, f"[mesh] listen = {listen}"), hosts))
        except Exception:
            self.close()
            raise

    def dial(self, peer: str) -> Pipe:
        """Connect to a neighbour; raises OSError."""
        address = self._addresses[peer]
        if isinstance(address, monikers.Tcp):
            return tcp.dial(address)
        assert self._air is not None
        return sim.dial(address.path, self._air, peer)

    def close(self) -> None:
        """Stop listening."""
        for listener in self.listeners:
            listener.close()
        if self._air is not None:
            self._air.close()
