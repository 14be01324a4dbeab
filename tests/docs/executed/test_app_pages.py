"""Each page of docs/apps: what belongs on it is there, and its pictures are made by the commands that stand there."""

import re
import subprocess
from pathlib import Path

import pytest
from test_tutorial import commands_on_the_path

from services.apps import loader

PAGES = Path(__file__).parents[3] / "docs/reference/apps"
PICTURE = re.compile(r"^```sh picture\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"!\[[^]]+\]\(\.\./\.\./images/([a-z0-9_]+\.png)\)")


@pytest.mark.parametrize("app", sorted(loader.BUILT_IN))
def test_every_app_has_its_page(app: str) -> None:
    text = (PAGES / f"{app}.md").read_text()
    assert f"swarm sim {app}" in text
    assert "Source: " in text or "Source:\n" in text
    assert "thesis" in text
    shown = SHOWN.findall(text)
    assert shown
    assert all((PAGES.parents[1] / "images" / name).is_file() for name in shown)
    # No picture without the command that makes it.
    made = re.findall(r"docs/images/([a-z0-9_]+\.png)", "".join(PICTURE.findall(text)))
    assert sorted(made) == sorted(shown)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("app", sorted(loader.BUILT_IN))
def test_its_pictures_are_made_by_the_commands_that_stand_there(app: str, tmp_path: Path, runtime: Path) -> None:
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    (home / "docs" / "images").mkdir(parents=True)
    environment = commands_on_the_path(tools, runtime)
    for block in PICTURE.findall((PAGES / f"{app}.md").read_text()):
        for command in block.replace("\\\n", "").splitlines():
            done = subprocess.run(
                ["/bin/sh", "-c", command], cwd=home, env=environment, capture_output=True, text=True, check=False,
                timeout=200,
            )  # fmt: skip
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    made = {path.name for path in (home / "docs" / "images").iterdir()}
    assert made == set(SHOWN.findall((PAGES / f"{app}.md").read_text()))
