"""The public address has one place, pyproject.toml: metadata, README and the release check take it from there."""

import email
import importlib.machinery
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
ADDRESS = "https://git.example.org/balboa-swarm"


def loaded(path: Path) -> ModuleType:
    loader = importlib.machinery.SourceFileLoader(path.stem, str(path))
    spec = importlib.util.spec_from_file_location(path.stem, path, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def with_address(text: str) -> str:
    return text.replace("[project.urls]\n", f'[project.urls]\nRepository = "{ADDRESS}"\n')


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """What the check of the address reads, in a repository of its own."""
    for name in ("pyproject.toml", "CITATION.cff"):
        shutil.copy(ROOT / name, tmp_path)
    identity = ("-c", "user.name=t", "-c", "user.email=t@example.org")
    for words in (("init", "--quiet"), ("add", "."), (*identity, "commit", "--quiet", "-m", "all")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


@pytest.fixture
def release(tree: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    module = loaded(ROOT / "tools" / "release")
    monkeypatch.setattr(module, "ROOT", tree)
    return module


def test_without_an_address_only_a_tagged_release_fails(
    release: ModuleType, tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    release.check_address("1.2.3")
    assert capsys.readouterr().out.startswith("no public address: before this goes to an index, set Repository")
    subprocess.run(["git", "tag", "v1.2.3"], cwd=tree, check=True)
    with pytest.raises(SystemExit):
        release.check_address("1.2.3")
    assert capsys.readouterr().out.startswith("FAILED: no public address")


def test_a_tagged_release_has_no_page_that_says_there_is_none_yet(
    release: ModuleType, tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tree / "docs").mkdir()
    (tree / "docs" / "a.md").write_text("It is not on a\npackage index yet.")
    (tree / "README.md").write_text("It is on an index.")
    release.check_pages("1.2.3")
    assert "take `not on a package index yet` out of docs/a.md" in capsys.readouterr().out
    subprocess.run(["git", "tag", "v1.2.3"], cwd=tree, check=True)
    with pytest.raises(SystemExit):
        release.check_pages("1.2.3")


def test_the_citation_has_the_same_address(release: ModuleType, tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project, citation = tree / "pyproject.toml", tree / "CITATION.cff"
    project.write_text(with_address(project.read_text()))
    with pytest.raises(SystemExit):
        release.check_address("1.2.3")
    assert f"CITATION.cff needs the line `repository-code: {ADDRESS}`" in capsys.readouterr().out
    citation.write_text(citation.read_text().replace("license:", f"repository-code: {ADDRESS}\nlicense:"))
    release.check_address("1.2.3")
    assert capsys.readouterr().out == f"address {ADDRESS}\n"


def test_a_python_that_is_named_must_be_there(release: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    here = {"3.11": "/usr/bin/python3.11"}
    monkeypatch.setattr(release, "interpreter", here.get)
    assert release.pythons(None) == release.pythons(["3.11"]) == here
    for named in (["3.13"], ["3.11", "3.13"]):
        with pytest.raises(SystemExit) as ended:
            release.pythons(named)
        assert ended.value.code == 1
    here.clear()
    with pytest.raises(SystemExit):
        release.pythons(None)


def test_links_and_pictures_of_the_readme_lead_to_the_files_of_the_release() -> None:
    pytest.importorskip("hatchling")
    absolute = loaded(ROOT / "tools" / "readme.py").absolute
    assert absolute("[a](b/c.md#d) ![e](f.webp) [g](#h) [i](https://j.org/k)", ADDRESS, "1.2.3") == (
        f"[a]({ADDRESS}/blob/v1.2.3/b/c.md#d) ![e]({ADDRESS}/raw/v1.2.3/f.webp) [g](#h) [i](https://j.org/k)"
    )
    text = absolute((ROOT / "README.md").read_text(), ADDRESS, "1.2.3")
    found = re.findall(rf"\]\({ADDRESS}/(?:blob|raw)/v1\.2\.3/([^)#]+)", text)
    assert len(found) > 20
    assert [path for path in found if not (ROOT / path).exists()] == []


def test_the_site_leads_to_the_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = pytest.importorskip("mkdocs.config", reason="mkdocs is not installed: ./run site installs it")
    monkeypatch.syspath_prepend(str(ROOT))
    pages = loaded(ROOT / "tools" / "site" / "pages.py")
    monkeypatch.setattr(pages, "PROJECT", tmp_path / "pyproject.toml")
    pages.PROJECT.write_text(with_address((ROOT / "pyproject.toml").read_text()))
    found = pages.on_config(config.load_config(str(ROOT / "mkdocs.yml")))
    assert [each["link"] for each in found.extra["social"]] == [ADDRESS]


def test_all_packages_promise_types() -> None:
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert [name for name in packages["packages"] if not (ROOT / name / "py.typed").is_file()] == []


@pytest.mark.slow
def test_the_metadata_of_a_wheel_has_the_address(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    tree = tmp_path / "tree"
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in files.split("\0")[:-1]:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    project = tree / "pyproject.toml"
    project.write_text(with_address(project.read_text()))
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=tree, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [each for each in archive.namelist() if each.endswith("/METADATA")]
        metadata = email.message_from_bytes(archive.read(name))
    assert metadata["Project-URL"] == f"Repository, {ADDRESS}"
    assert "![Six simulated robots" in str(metadata.get_payload())
    assert f"({ADDRESS}/raw/v{metadata['Version']}/docs/images/film.webp)" in str(metadata.get_payload())
