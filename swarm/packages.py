"""The platform's top-level packages: an author's own file of the same name would hide one.

Only the standard library is imported here.
"""

from importlib.util import find_spec
from pathlib import Path

NAMES = ("laptop", "services", "sim", "swarm")
HOME = Path(__file__).resolve().parents[1]
"""The folder that holds the packages."""
PARTS = HOME if (HOME / "deploy" / "install").is_file() else HOME / "balboa_swarm_parts"
"""Where `deploy`, `examples` and `firmware` lie: in a checkout its root, else beside our packages (pyproject.toml)."""


def rename(path: Path) -> str:
    """Return the sentence that tells an author to rename the file or folder `path`."""
    return f"{path} has the name of a package of Balboa Swarm and would hide it: rename the file or folder"


def check_found() -> None:
    """Raise `ImportError` if Python finds something else under the name of one of the packages.

    A script's own folder comes first where Python looks for modules, so `sim.py` beside the script hides `sim`.
    """
    for name in NAMES:
        spec = find_spec(name)
        if spec is None or spec.origin is None:  # robots carry two of them; a folder without Python hides nothing
            continue
        file = Path(spec.origin).resolve()
        if not file.is_relative_to(HOME / name):
            raise ImportError(rename(file.parent if file.name == "__init__.py" else file))
