"""The imports of an app that robots lack: they would work here, and on no robot."""

import contextlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from services.apps import sources
from swarm.config import load
from swarm.errors import LocalError

ROBOT_MODULES = frozenset({"eclipse_zenoh", "msgpack", "serial", "services", "smbus2", "swarm", "tomli_w", "zenoh"})
"""What robots carry beside Python's own modules: our two packages and those of `requirements-robot.lock`."""

LAPTOP_MODULES = ("laptop", "sim")
"""Our packages that robots do not carry."""


def missing_imports(source: str, packages: Sequence[str] = ()) -> list[str]:
    """Return one sentence with file and line for each import of the app in the file `source` that robots lack.

    `packages`: those of `[robot] packages`. The modules beside the app go to robots with it, and are looked at, too.
    """
    folder = Path(source).parent
    carried = {re.split(r"[^A-Za-z0-9_.-]", each)[0].replace("-", "_").lower() for each in packages}
    found = []
    for file, data in sources.of_app(Path(source)).items():
        for line, name in sources.imports(data):
            top = name.partition(".")[0]
            here = top in sys.stdlib_module_names or top in ROBOT_MODULES or top.lower() in carried
            if here or sources.beside(folder, top) or sources.beside((folder / file).parent, top):
                continue
            mend = "if [robot] packages of swarm.toml does not name it"
            if top in LAPTOP_MODULES:
                mend = "which is for laptops alone: import it in a script beside the app"
            found.append(f"{folder / file}, line {line}: import of {name}: robots lack it, {mend}")
    return found


def own_packages() -> tuple[str, ...]:
    """Return `[robot] packages` of the swarm.toml here, where there is one that can be read."""
    with contextlib.suppress(LocalError):
        return load(addressed=False).packages
    return ()
