"""The plan to start an app on robots: in the run that they have in common, or in a new one.

All of them are to run the same release, configuration and firmware, as for `swarm run`. Whoever is late is held against
what was decided before.
"""

from laptop.fleet import apps
from laptop.fleet.release.versions import Versions
from laptop.fleet.ssh.ssh import HostError
from swarm.config import Config


class Plan:
    """The plan of one start."""

    def __init__(self, app: str, config: Config, *, alone: bool) -> None:
        """`alone`: whether the start is for one robot, while others may run the app."""
        self._app = app
        self._config = config
        self._alone = alone
        self._versions: dict[str, Versions] = {}
        self._known: dict[str, apps.StartedApp | None] = {}
        self._refused: dict[str, str] = {}
        """The problems that robots have reported, and the first robot of each."""
        self._anew: bool | None = None
        self._run: apps.StartedApp | None = None
        """The app's run that the robots continue; None before the first one has answered."""

    def found(self, robot: str, versions: Versions, known: apps.StartedApp | None) -> None:
        """Note the versions on a robot, and how the app was started there last."""
        self._versions[robot], self._known[robot] = versions, known

    def is_new(self, robot: str) -> bool:
        """Return whether the app begins anew on a robot that was found. Raises `HostError` where it is not to be
        started."""
        if wrong := apps.differences(self._versions, self._config):
            first = self._refused.setdefault(wrong, robot)
            raise HostError(wrong if robot == first else f"see {first}")
        run = self._known[robot]
        if self._anew is None:
            self._decide()
        if not self._anew and run != self._run:
            raise HostError(f"the others go on with another run of it: swarm run {self._app} begins one on all")
        return bool(self._anew)

    def _decide(self) -> None:
        runs = set(self._known.values())
        if len(runs) == 1 and None not in runs:
            self._anew, self._run = False, runs.pop()
            return
        if self._alone:
            raise HostError("it has not run it yet: start it on all robots")
        if brought := sorted(robot for robot, run in self._known.items() if run is not None and not run.built_in):
            raise HostError(
                f"it is a file of yours, which not all robots have in the same run ({' '.join(brought)} have one): "
                f"swarm run {self._app}.py"
            )
        self._anew = True
