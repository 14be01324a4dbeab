"""A swarm on Foxglove's WebSocket: what a feed knows is told each 50 ms, newest first; parameters can be set.

The maker's SDK (the extra `foxglove`) serves; which topics there are and what they hold is in
`laptop.foxglove.messages` and `scene`.
"""

import logging
import threading
import time
from typing import Any

from laptop.foxglove import scene
from laptop.foxglove.messages import FoxgloveMessage, frames, log, sample
from laptop.view.actions.control import Control
from laptop.view.feeds.feed import LiveFeed
from swarm.errors import LocalError, MissingPackageError

try:
    import foxglove
    from foxglove.websocket import Capability, Parameter
except ModuleNotFoundError:
    raise MissingPackageError("swarm foxglove", "foxglove-sdk", "foxglove") from None

PERIOD = 0.05
"""Seconds between two searches for new messages."""
FAILED_S = 0.5
"""Seconds without work after some has failed."""
HOST = "127.0.0.1"

_log = logging.getLogger("foxglove")


class FoxgloveServer:
    """Serves a feed until closed."""

    def __init__(self, feed: LiveFeed, control: Control, port: int, *, writable: bool) -> None:
        """`port`: a port of 127.0.0.1; 0 = any free one. `writable`: whether clients may set parameters of apps. Raises
        `LocalError` where the port is taken."""
        self._feed = feed
        self._control = control
        self._writable = writable
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._version = 0
        self._late = threading.Event()
        """Whether a client has subscribed since the last search."""
        self._event = 0
        try:
            self._server = foxglove.start_server(
                name=f"Balboa Swarm: {feed.kind}",
                host=HOST,
                port=port,
                capabilities=[Capability.Parameters],
                server_listener=self,  # type: ignore[arg-type]
                context=self._context,
            )
        except RuntimeError as error:
            raise LocalError(f"{HOST}:{port}: {error}: choose another one with --port") from None
        self.port: int = self._server.port
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._server.stop()

    # What clients ask, on the SDK's threads

    def on_get_parameters(self, client: Any, names: list[str], request_id: str | None = None) -> list[Parameter]:
        """Return the values of parameters, called `robot.app.name`; all where none is named."""
        known = self._parameters()
        return [Parameter(name, value=known[name]) for name in names or known if name in known]

    def on_set_parameters(
        self, client: Any, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Ask apps for other values. Clients are told the values that apps have as soon as these answer."""
        for each in parameters if self._writable else ():
            robot, _, rest = each.name.partition(".")
            app, _, name = rest.partition(".")
            try:
                self._control.do({"act": "set", "robot": robot, "app": app, "name": name, "value": each.get_value()})
            except LocalError as error:
                _log.warning("%s is not set: %s", each.name, error)
        if not self._writable:
            _log.warning("no parameter is set: start `swarm foxglove --control` for that")
        return self.on_get_parameters(client, [each.name for each in parameters])

    def on_parameters_subscribe(self, names: list[str]) -> None:
        """Do nothing: parameters are published whenever a robot reports them."""

    def on_parameters_unsubscribe(self, names: list[str]) -> None:
        """Do nothing, as `on_parameters_subscribe`."""

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Publish what was published before for a new subscriber, since much is published on change only."""
        self._late.set()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing: the SDK records the subscribers."""

    def _parameters(self) -> dict[str, Any]:
        """Return the parameters of all apps, by `robot.app.name`."""
        config, found = self._feed.config, {}
        with self._feed.lock:
            for robot in config.names if config is not None else ():
                for topic in self._feed.picture.topics(robot):
                    service, _, last = topic.rpartition("/")
                    if last == "parameters" and service.startswith("app/"):
                        value = self._feed.picture.newest(robot, topic)
                        entries = value.get("parameters") if isinstance(value, dict) else None
                        for name, each in (entries or {}).items():
                            found[f"{robot}.{service.removeprefix('app/')}.{name}"] = each.get("value")
        return found

    # What is told

    def _run(self) -> None:
        while not self._closing.wait(PERIOD):
            for work in (self._tell, self._control.repeat) if self._writable else (self._tell,):
                try:
                    work()
                except Exception:  # noqa: BLE001 - a defect here; what robots have not confirmed is repeated all the same
                    _log.exception("a step for Foxglove has failed")
                    self._closing.wait(FAILED_S)

    def _tell(self) -> None:
        told = self._look(time.time_ns())
        if any(topic.endswith("/parameters") for topic in told):
            known = self._parameters()
            self._server.publish_parameter_values([Parameter(name, value=known[name]) for name in known])

    def _look(self, log_time: int) -> list[str]:
        """Tell clients what is new, and return its topics."""
        feed, config = self._feed, self._feed.config
        messages: list[FoxgloveMessage] = []
        with feed.lock:
            picture = feed.picture
            if self._late.is_set():
                self._late.clear()
                self._version = 0
            if config is None or picture.version == self._version:
                return []
            since, self._version = self._version, picture.version
            for robot in picture.robots:
                for topic, value in picture.values(robot, picture.since(robot, since, since)).items():
                    if (message := sample(robot, topic, value, log_time)) is not None:
                        messages.append(message)
            events = picture.events_since(self._event)
            messages += log(events, log_time)
            messages.append(frames(scene.robot_poses(picture, config), log_time))
            messages.append(scene.scene_update(picture, config, log_time))
        if events:
            self._event = events[-1].number
        for message in messages:
            self._channel(message).log(message.data, log_time=log_time)
        return [message.topic for message in messages]

    def _channel(self, message: FoxgloveMessage) -> foxglove.Channel:
        channel = self._channels.get(message.topic)
        if channel is None:
            schema = foxglove.Schema(name=message.schema_name, encoding="jsonschema", data=message.schema)
            channel = self._channels[message.topic] = foxglove.Channel(
                message.topic, schema=schema, message_encoding="json", context=self._context
            )
        return channel
