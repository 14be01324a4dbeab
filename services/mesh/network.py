"""The transports of one robot: where it listens, and how it reaches the neighbours that it dials."""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from services.mesh import link_address
from services.mesh.core.link.calls import Local, has_address
from services.mesh.links import pybluez, rfcomm, role, sim, slots, supervision, tcp
from services.mesh.links.page import Paging
from services.mesh.links.pipe import Pipe
from services.mesh.sockets import Listener
from swarm.bluetooth.adapter import Adapter
from swarm.config import Config
from swarm.errors import ConfigError, LocalError

ANY_ADAPTER = "00:00:00:00:00:00"
"""BDADDR_ANY: the kernel chooses, for a robot that only calls by Bluetooth and names no adapter."""

_log = logging.getLogger("mesh")


class Network:
    """Everything this robot needs to meet its neighbours; `directory` is its runtime directory."""

    def __init__(
        self,
        config: Config,
        local: Local,
        directory: Path,
        *,
        open_bluetooth: rfcomm.Open = rfcomm.open_socket,
        supervise: Callable[[str, str, float], None] = supervision.try_limit,
        open_adapter: role.OpenAdapter = Adapter,
    ) -> None:
        self._supervise = supervise
        robots = {name: config.robot(name) for name in local.dials}
        called = {peer: link_address.of_robot(robots[peer]) for peer, we_dial in local.dials.items() if we_dial}
        callers = [peer for peer, we_dial in local.dials.items() if not we_dial]
        me = config.robot(local.robot)
        # One that only calls listens, too, where a robot without any link knocks at those that should call it.
        own = link_address.of_robot(me) if callers or (local.pages and local.dials) else None
        listen = config.mesh.listen
        near = {peer: link_address.of_robot(robots[peer]) for peer in callers if has_address(robots[peer])}
        hosts = {address.host for address in near.values() if isinstance(address, link_address.Tcp)}
        self._addresses = {**called, **near}
        # Whom the configuration links with us must be able to call; others may become neighbours one day.
        first = local.dials if config.auto else config.neighbours(local.robot)
        needed = [peer for peer in callers if peer in first]
        if isinstance(own, link_address.Tcp) and listen is None:
            if needed:
                raise ConfigError(
                    f"{config.path}: [mesh] listen: {', '.join(needed)} will dial {local.robot} over tcp:, "
                    f'so say where it listens, for example "0.0.0.0:{own.port}"'
                )
            own = None
        kinds = {type(each) for each in (own, *called.values())}
        required = {type(called[peer]) for peer in first if peer in called}
        if needed and own is not None:
            required.add(type(own))
        self._open_bluetooth = open_bluetooth
        self._calls_all = not callers
        settings = config.mesh
        self._radio = rfcomm.Radio(
            me.bluetooth or ANY_ADAPTER, settings.rfcomm_channel, settings.rfcomm_encrypt, calls_all=self._calls_all
        )
        self._paging = Paging(self._radio.adapter, open_adapter=open_adapter)
        by_radio = {
            peer: address.address
            for peer, address in self._addresses.items()
            if isinstance(address, link_address.Rfcomm)
        }
        self.roles = role.Roles(self._radio.adapter, by_radio, open_adapter=open_adapter)
        self._record: pybluez.Record | None = None
        self._air = sim.LinkConditions(local.robot, directory) if link_address.Sim in kinds else None
        self.listeners: list[Listener] = []
        self._me = local.robot
        try:
            if isinstance(own, link_address.Slots):
                self.listeners.append(slots.SlotsListener(own.path, directory, local.robot))
            if link_address.Rfcomm in required:
                _check_bluetooth(open_bluetooth)
            if isinstance(own, link_address.Sim) and self._air is not None:
                self.listeners.append(sim.SimListener(own.path, self._air))
            if isinstance(own, link_address.Rfcomm):
                known = {robot.bluetooth: robot.name for robot in config.robots if robot.bluetooth is not None}
                listener = rfcomm.RfcommListener(self._radio, known, open_socket=open_bluetooth, supervise=supervise)
                self.listeners.append(listener)
                self._record = _advertise(listener)
            if listen is not None:
                self.listeners.append(
                    tcp.TcpListener(link_address.parse_address(listen, f"[mesh] listen = {listen}"), hosts)
                )
        except Exception:
            self.close()
            raise

    def dial(self, peer: str) -> Pipe:
        """Connect to a neighbour; raises OSError."""
        address = self._addresses.get(peer)
        if address is None:
            raise ConnectionError(f"the configuration has no address of {peer}")
        if isinstance(address, link_address.Tcp):
            return tcp.dial(address)
        if isinstance(address, link_address.Rfcomm):
            try:
                pipe = rfcomm.dial(self._radio, address.address, paging=self._paging, open_socket=self._open_bluetooth)
            except LocalError as error:  # no Bluetooth here, and no configured neighbour that needs it
                raise ConnectionError(str(error)) from None
            pipe.limit = partial(self._supervise, self._radio.adapter, address.address)
            return pipe
        if isinstance(address, link_address.Slots):
            return slots.dial(address.path, self._me, peer)
        assert self._air is not None
        return sim.dial(address.path, self._air, peer)

    def follow(self, dials: Mapping[str, bool]) -> None:
        """Take whom this robot calls now: another hub may have been chosen."""
        calls_all = all(dials.values())
        if calls_all != self._calls_all:
            self._calls_all = calls_all
            for listener in self.listeners:
                if isinstance(listener, rfcomm.RfcommListener):
                    listener.set_calls_all(calls_all)

    def close(self) -> None:
        if self._record is not None:
            self._record.close()
        for listener in self.listeners:
            listener.close()
        if self._air is not None:
            self._air.close()


def _check_bluetooth(open_bluetooth: rfcomm.Open) -> None:
    """Say at the start, not at each dial, that this interpreter or kernel has no Bluetooth."""
    try:
        open_bluetooth().close()
    except OSError as error:
        raise LocalError(f"rfcomm: links need Bluetooth: {rfcomm.explained(error).strerror}") from None


def _advertise(listener: rfcomm.RfcommListener) -> pybluez.Record | None:
    """Publish a service record where PyBluez and bluetoothd are there for it; no link needs one."""
    try:
        return pybluez.Record(listener.fileno())
    except (LocalError, OSError) as error:
        _log.info("no service record: %s", error)
        return None
