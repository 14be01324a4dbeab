"""`deploy/install` and a power cut after any of its commands: the robot boots with one release, its config and its key.

The script runs below a folder that stands for the robot's root, with doubles of systemd's programs. After each command
that changes the disk the tree is written down. A power cut leaves what the last `sync` has brought to the disk, and of
the changes since then none, all, any single one, or all but one; a file that is new among them may be empty.
"""

import fcntl
import os
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
PLACES = re.compile(r"""(?<=[\s"'=<>])/(?=(etc|opt/swarm|usr/local/lib/systemd|run|var/lib/swarm)\b)""")
"""Where the scripts name a place below the robot's root."""

PROGRAMS = (
    "mv", "cp", "ln", "rm", "rmdir", "install", "mkdir", "touch", "chmod", "sync", "grep", "pip", "systemctl",
    "systemd-sysusers", "systemd-tmpfiles", "udevadm", "sleep", "id",
)  # fmt: skip
"""Programs after which the tree is written down; `grep` stands for the shell's own redirections."""

Tree = dict[str, tuple[str, str]]
"""By path: kind (file, link, folder) and content or target."""

SHIM = """#!/bin/sh
# Does what the program of this name does, or its double, and writes the tree down.
name=${0##*/} PATH=@PATH@
code=0
[ ! -e "@ROOT@/../stop-at-$name" ] || : >@ROOT@/stopped-swarm-balancer
case $name in
sync | pip | systemd-* | udevadm | sleep) ;;
id) echo 0; exit ;;
install) # without the owner: the tests' user has no users of ours
    install -m "$2" "$7" "$8" ;;
systemctl)
    case $1 in
    enable)
        wants=@ROOT@/etc/systemd/system/swarm.target.wants
        mkdir -p $wants
        for unit in swarm-bus.service swarm-mesh.service; do
            [ -L $wants/$unit ] || ln -s @ROOT@/usr/local/lib/systemd/system/$unit $wants/$unit
        done ;;
    is-active) # of several names, whether one is
        code=3
        for unit; do
            case $unit in
            is-active | --quiet) ;;
            *) [ -e "@ROOT@/dead-$unit" ] || [ -e "@ROOT@/stopped-$unit" ] || code=0 ;;
            esac
        done
        ! grep -q broken @ROOT@/opt/swarm/current/bin/python || code=3
        (exit $code) ;;
    show)
        for unit; do :; done
        case $* in
        *ActiveState*) [ -e "@ROOT@/stopped-$unit" ] && echo inactive || echo active ;;
        *) echo 0 ;;
        esac ;;
    start | restart) echo "$*" >>@ROOT@/../started ;;
    esac ;;
*) $name "$@" ;;
esac || code=$?
[ -d @LOG@ ] || exit $code # nobody looks at the trees
read -r count <@LOG@/count
echo $((count + 1)) >@LOG@/count
tar --create --directory=@ROOT@ --file=@LOG@/$count.tar .
echo $name >@LOG@/$count.name
exit $code
"""

PYTHON = """#!/bin/sh
# The system's Python: makes an environment with our release in it.
case "$*" in
*ensurepip*) exit 0 ;;
*venv*)
    for last; do :; done
    mkdir -p "$last/bin"
    for name in pip swarm python; do cp "$SHIMS/../release/$name" "$last/bin/$name"; done ;;
esac
"""


def tree_of(archive: Path) -> Tree:
    tree: Tree = {}
    with tarfile.open(archive) as members:
        for each in members:
            if each.issym():
                it = ("link", each.linkname)
            elif each.isdir():
                it = ("folder", "")
            else:
                content = members.extractfile(each)
                assert content is not None, each.name
                it = ("file", content.read().decode())
            tree[each.name.removeprefix("./")] = it
    tree.pop(".")
    return tree


class Boot(NamedTuple):
    """What the robot runs after the next boot."""

    release: str
    unit: str
    dropin: str
    config: str
    key: str
    name: str


class Robot:
    """A folder that stands for a robot's root."""

    def __init__(self, place: Path) -> None:
        self.root = place / "root"
        self.shims = place / "shims"
        self.log = place / "log"
        self.place = place
        for folder in ("etc/swarm", "etc/systemd/system", "opt", "run/systemd/system", "usr/local/lib"):
            (self.root / folder).mkdir(parents=True)
        self.shims.mkdir()
        shim = SHIM.replace("@ROOT@", str(self.root)).replace("@LOG@", str(self.log))
        shim = shim.replace("@PATH@", os.environ["PATH"])
        for name in PROGRAMS:
            (self.shims / name).write_text(shim)
            (self.shims / name).chmod(0o755)
        (self.shims / "python3.99").write_text(PYTHON)
        (self.shims / "python3.99").chmod(0o755)

    def release(self, number: str, *, runs: bool = True, units: tuple[str, ...] = ()) -> Path:
        """An unpacked release; its programs are doubles."""
        folder = self.place / "release"
        if folder.exists():
            folder.rename(self.place / f"before-{os.urandom(4).hex()}")
        (folder / "wheels").mkdir(parents=True)
        (folder / "wheels" / f"balboa_swarm-{number}-py3-none-any.whl").touch()
        (folder / "requirements-robot.lock").touch()
        (folder / "ID").write_text(f"{number}\n")
        (folder / "FOR").write_text(f"{os.uname().machine} 3.99\n")
        systemd = folder / "systemd"
        (systemd / "swarm-.service.d").mkdir(parents=True)
        for unit in ("swarm-bus.service", "swarm-mesh.service", "swarm-app@.service", *units):
            (systemd / unit).write_text(number)
        for each in ("swarm.target", "swarm.slice", "swarm.sysusers", "swarm.tmpfiles", "60-swarm.rules"):
            (systemd / each).write_text(number)
        (systemd / "swarm-.service.d/10-common.conf").write_text(number)
        (folder / "pip").write_text("#!/bin/sh\nexec pip\n")
        (folder / "swarm").write_text(
            '#!/bin/sh\nfor it; do :; done\n[ "$it" != --json ] || echo \'{"robots": {"r0": 1}, "unaddressed": []}\'\n'
        )
        (folder / "python").write_text(f"#!/bin/sh\n# {'runs' if runs else 'broken'}\nexit 0\n")
        for each in ("pip", "swarm", "python"):
            (folder / each).chmod(0o755)
        for script in ("install", "uninstall"):
            (folder / script).write_text(PLACES.sub(f"{self.root}/", (DEPLOY / script).read_text()))
            (folder / script).chmod(0o755)
        return folder

    def do(self, script: Path, *arguments: str | Path, code: int = 0) -> None:
        """Run the script, without the trees, which take most of the time."""
        environment = {**os.environ, "PATH": f"{self.shims}:{os.environ['PATH']}", "SHIMS": str(self.shims)}
        done = subprocess.run(
            ["sh", script, *arguments], env=environment, capture_output=True, text=True, timeout=240, check=False
        )
        assert done.returncode == code, done.stdout + done.stderr

    def run(self, script: Path, *arguments: str | Path, code: int = 0) -> list[tuple[str, Tree]]:
        """The trees after each command."""
        self.log.mkdir()
        with tarfile.open(self.log / "0.tar", "w") as archive:
            archive.add(self.root, ".")
        (self.log / "0.name").write_text("begin")
        (self.log / "count").write_text("1\n")
        self.do(script, *arguments, code=code)
        count = int((self.log / "count").read_text())
        steps = [
            ((self.log / f"{at}.name").read_text().strip(), tree_of(self.log / f"{at}.tar")) for at in range(count)
        ]
        shutil.rmtree(self.log)
        return steps

    def read(self, tree: Tree, path: str) -> str | None:
        """The text of a file, through links, in a tree; None where it is not there."""
        for _ in range(20):
            parts, walked = path.split("/"), ""
            for at, part in enumerate(parts):
                walked = f"{walked}/{part}".lstrip("/")
                kind, it = tree.get(walked, ("", ""))
                if kind == "link":
                    assert it.startswith(str(self.root)), it
                    path = "/".join([it.removeprefix(f"{self.root}/"), *parts[at + 1 :]])
                    break
            else:
                kind, it = tree.get(path, ("", ""))
                return it if kind == "file" else None
        raise AssertionError(f"links without end at {path}")

    def boot(self, tree: Tree) -> Boot | None:
        """What runs after a boot from a tree; None where no service is enabled."""
        if not any(path.startswith("etc/systemd/system/swarm.target.wants/") for path in tree):
            return None

        def unit(name: str) -> str:
            for folder in ("etc/systemd/system", "usr/local/lib/systemd/system"):
                if (text := self.read(tree, f"{folder}/{name}")) is not None:
                    return text
            return "none"

        release = self.read(tree, "opt/swarm/current/systemd/swarm.target")
        assert self.read(tree, "opt/swarm/current/complete") is not None, "a release that is not whole"
        assert self.read(tree, "opt/swarm/current/bin/python"), "a release that is not whole"
        return Boot(
            release or "none",
            unit("swarm-bus.service"),
            unit("swarm-.service.d/10-common.conf"),
            self.read(tree, "etc/swarm/swarm.toml") or "none",
            self.read(tree, "etc/swarm/key") or "none",
            self.read(tree, "etc/swarm/robot.env") or "none",
        )


def cuts(steps: list[tuple[str, Tree]]) -> Iterator[tuple[int, Tree]]:
    """Each tree that a power cut may leave, with the number of commands before it."""
    synced = steps[0][1]
    for count, (name, now) in enumerate(steps):
        if name == "sync":
            synced = now
        changed = [path for path in {**synced, **now} if synced.get(path) != now.get(path)]
        yield count, now
        yield count, synced
        for path in changed:
            for base, other in ((synced, now), (now, synced)):
                tree = dict(base)
                if path in other:
                    tree[path] = other[path]
                else:
                    tree.pop(path, None)
                yield count, tree
            if now.get(path, ("",))[0] == "file" and now[path] not in synced.values():  # else renamed after a sync
                yield count, {**now, path: ("file", "")}


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def files(robot: Robot, number: str) -> list[str | Path]:
    """Options with a config and a key of their own."""
    config, key = robot.place / f"config-{number}", robot.place / f"key-{number}"
    config.write_text(f"config {number}")
    key.write_text(f"key {number}")
    return ["--name", "r0", "--config", config, "--key", key]


def whole(number: str) -> Boot:
    name = "SWARM_ROBOT=r0\n"
    return Boot(number, number, number, f"config {number}", f"key {number}", name)


def check(robot: Robot, steps: list[tuple[str, Tree]], old: Boot | None, new: Boot | None) -> None:
    """The robot boots with the old or the new, and with the new one once the script has ended."""
    for count, tree in cuts(steps):
        found = robot.boot(tree)
        assert found in (old, new), (count, [name for name, _ in steps[: count + 1]])
        if count == len(steps) - 1:
            assert found == new, count


def test_a_first_installation_is_whole_or_not_there_after_a_cut_at_any_command(robot: Robot) -> None:
    steps = robot.run(robot.release("1") / "install", *files(robot, "1"))
    assert len(steps) > 40
    check(robot, steps, None, whole("1"))


def test_another_release_with_its_config_and_key_comes_whole_or_not_at_all(robot: Robot) -> None:
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    steps = robot.run(robot.release("2") / "install", *files(robot, "2"))
    check(robot, steps, whole("1"), whole("2"))


def test_a_release_of_which_one_service_is_dead_does_not_run_already(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    names = [name for name, _ in robot.run(release / "install", *files(robot, "1"))]
    assert "systemd-sysusers" not in names
    (robot.root / "dead-swarm-mesh").touch()
    names = [name for name, _ in robot.run(release / "install", *files(robot, "1"), code=1)]
    assert "systemd-sysusers" in names


@pytest.mark.parametrize(
    ("moment", "runs", "starts"),
    [("mkdir", True, [False]), ("sleep", True, [True]), ("sleep", False, [True, False])],
)
def test_a_balancer_that_is_stopped_during_an_install_is_not_started_again(
    robot: Robot, moment: str, starts: list[bool], *, runs: bool
) -> None:
    """As `swarm estop` does where a robot's bus gives no answer; `mkdir` unpacks, and `sleep` looks whether all run."""
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    (robot.place / "started").unlink()
    release = robot.release("2", runs=runs)
    (robot.place / f"stop-at-{moment}").touch()
    robot.do(release / "install", *files(robot, "2"), code=0 if runs else 1)
    restarted = [each for each in (robot.place / "started").read_text().splitlines() if "swarm-mesh" in each]
    assert ["swarm-balancer" in each for each in restarted] == starts


def test_only_root_can_lock_out_installations(robot: Robot) -> None:
    release = robot.release("1")
    robot.run(release / "install", *files(robot, "1"))
    assert (robot.root / "run/swarm-install.lock").stat().st_mode & 0o777 == 0o600
    assert (robot.root / "opt/swarm/releases/1/complete").stat().st_mode & 0o777 == 0o644


def test_two_installations_at_once_do_not_meet(robot: Robot) -> None:
    release = robot.release("1")
    with (robot.root / "run/swarm-install.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        steps = robot.run(release / "install", *files(robot, "1"), code=2)
    assert not (robot.root / "opt/swarm").exists()
    assert len(steps) < 5


@pytest.mark.slow
def test_another_config_and_key_for_the_same_release_come_together(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    steps = robot.run(release / "install", *files(robot, "2"))
    new = whole("1")._replace(config="config 2", key="key 2")
    check(robot, steps, whole("1"), new)


@pytest.mark.slow
def test_a_release_that_does_not_run_is_taken_back_with_its_config_and_key(robot: Robot) -> None:
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    steps = robot.run(
        robot.release("2", runs=False, units=("swarm-new.service",)) / "install", *files(robot, "2"), code=1
    )
    assert robot.boot(steps[-1][1]) == whole("1")
    for _, tree in cuts(steps):
        assert robot.boot(tree) in (whole("1"), whole("2"))
    for count, tree in cuts(steps):
        if count == len(steps) - 1:
            assert robot.boot(tree) == whole("1")
    assert not (robot.root / "usr/local/lib/systemd/system/swarm-new.service").exists()


def test_releases_that_do_not_run_or_are_refused_do_not_fill_the_disk(robot: Robot) -> None:
    for number in ("1", "2"):
        robot.do(robot.release(number) / "install", *files(robot, number))
    for number in ("3", "4", "5"):
        robot.do(robot.release(number, runs=False) / "install", *files(robot, number), code=1)
    for number in ("6", "7"):
        release = robot.release(number)
        (release / "swarm").write_text("#!/bin/sh\nexit 1\n")
        robot.do(release / "install", *files(robot, number), code=2)
    assert (robot.root / "opt/swarm/current").readlink().name == "2"
    assert sorted(path.name for path in (robot.root / "opt/swarm/releases").iterdir()) == ["2", "7"]
    assert len(list((robot.root / "opt/swarm/settings").iterdir())) <= 2


def test_a_release_that_was_never_seen_to_run_is_not_what_another_attempt_goes_back_to(robot: Robot) -> None:
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    release = robot.release("2")
    robot.do(release / "install", *files(robot, "2"))
    good = robot.root / "opt/swarm/good"
    assert good.readlink() == (robot.root / "opt/swarm/current").readlink()
    good.unlink()  # as where the power fails before the services of release 2 have come up
    good.symlink_to(robot.root / "opt/swarm/releases/1")
    (robot.root / "opt/swarm/current/bin/python").write_text("#!/bin/sh\n# broken\nexit 0\n")
    steps = robot.run(release / "install", *files(robot, "3"), code=1)
    assert robot.boot(steps[-1][1]) == whole("1")


def test_a_release_that_came_up_at_a_later_boot_is_what_a_failed_attempt_goes_back_to(robot: Robot) -> None:
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    robot.do(robot.release("2") / "install", *files(robot, "2"))
    good = robot.root / "opt/swarm/good"
    good.unlink()  # as where the power fails before the services of release 2 have come up
    good.symlink_to(robot.root / "opt/swarm/releases/1")
    steps = robot.run(robot.release("3", runs=False) / "install", *files(robot, "3"), code=1)
    assert robot.boot(steps[-1][1]) == whole("2")


def test_a_release_that_was_switched_to_and_not_started_is_not_taken_for_good(robot: Robot) -> None:
    """The processes that run are those of the release before it, until a boot."""
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    robot.do(robot.release("2") / "install", *files(robot, "2"))
    switched = robot.root / "run/swarm-install.switched"
    assert not switched.exists()
    switched.touch()
    good = robot.root / "opt/swarm/good"
    good.unlink()
    good.symlink_to(robot.root / "opt/swarm/releases/1")
    steps = robot.run(robot.release("3", runs=False) / "install", *files(robot, "3"), code=1)
    assert robot.boot(steps[-1][1]) == whole("1")
    assert not switched.exists()


def test_a_release_that_was_switched_to_and_not_started_is_started_by_the_next_attempt(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    switched = robot.root / "run/swarm-install.switched"
    switched.touch()
    steps = robot.run(release / "install", *files(robot, "1"))
    assert "systemctl" in [name for name, _ in steps]
    assert not switched.exists()


def test_settings_that_were_never_seen_to_run_are_not_what_a_failed_attempt_goes_back_to(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    seen = (robot.root / "opt/swarm/current/etc.good").readlink()
    robot.do(release / "install", *files(robot, "2"))
    good_etc = robot.root / "opt/swarm/current/etc.good"
    assert good_etc.readlink() != seen
    good_etc.unlink()  # as where the power fails before the services have come up with the settings 2
    good_etc.symlink_to(seen)
    (robot.root / "opt/swarm/current/bin/python").write_text("#!/bin/sh\n# broken\nexit 0\n")
    steps = robot.run(release / "install", *files(robot, "3"), code=1)
    assert robot.boot(steps[-1][1]) == whole("1")


def test_a_key_that_somebody_has_put_there_outlives_two_attempts_that_fail(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    key = robot.root / "etc/swarm/key"
    key.unlink()
    key.write_text("by hand")
    (robot.root / "opt/swarm/current/bin/python").write_text("#!/bin/sh\n# broken\nexit 0\n")
    config = files(robot, "2")[:4]
    for _ in range(2):
        steps = robot.run(release / "install", *config, code=1)
        assert robot.boot(steps[-1][1]) == whole("1")._replace(key="by hand")


def test_settings_that_came_up_at_a_later_boot_are_what_a_failed_attempt_goes_back_to(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    good_etc = robot.root / "opt/swarm/current/etc.good"
    seen = good_etc.readlink()
    robot.do(release / "install", *files(robot, "2"))
    good_etc.unlink()
    good_etc.symlink_to(seen)
    steps = robot.run(robot.release("2", runs=False) / "install", *files(robot, "3"), code=1)
    assert robot.boot(steps[-1][1]) == whole("1")._replace(config="config 2", key="key 2")


@pytest.mark.slow
def test_a_config_that_does_not_run_is_taken_back_within_one_release(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    current = robot.root / "opt/swarm/current/bin/python"
    current.write_text("#!/bin/sh\n# broken\nexit 0\n")
    steps = robot.run(release / "install", *files(robot, "2"), code=1)
    assert robot.boot(steps[-1][1]) == whole("1")


@pytest.mark.slow
def test_files_that_somebody_has_replaced_are_kept_and_go_with_their_release(robot: Robot) -> None:
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    config = robot.root / "etc/swarm/swarm.toml"
    config.unlink()
    config.write_text("by hand")
    steps = robot.run(robot.release("2", runs=False) / "install", *files(robot, "2"), code=1)
    old = whole("1")._replace(config="by hand")
    for _, tree in cuts(steps):
        assert robot.boot(tree) in (old, whole("2"))
    assert robot.boot(steps[-1][1]) == old


@pytest.mark.slow
def test_a_robot_of_an_earlier_layout_is_taken_over_whole(robot: Robot) -> None:
    """Its units, config and key are files of their own."""
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    units, old = robot.root / "usr/local/lib/systemd/system", robot.root / "etc/systemd/system"
    shutil.copytree(units, old, dirs_exist_ok=True)
    units.unlink()
    wants = old / "swarm.target.wants"
    for each in list(wants.iterdir()):
        each.unlink()
        each.symlink_to(old / each.name)
    for name in ("swarm.toml", "key", "robot.env"):
        path = robot.root / "etc/swarm" / name
        text = path.read_text()
        path.unlink()
        path.write_text(text)
    (robot.root / "opt/swarm/releases/1/etc").unlink()
    steps = robot.run(robot.release("2") / "install", *files(robot, "2"))
    check(robot, steps, whole("1"), whole("2"))
    for each in wants.iterdir():
        assert each.read_text() == "2"


@pytest.mark.slow
def test_an_installation_that_was_cut_off_is_done_again(robot: Robot) -> None:
    """From each tree that a kill of the script leaves, the same command ends with the new release."""
    robot.do(robot.release("1") / "install", *files(robot, "1"))
    release, options = robot.release("2"), files(robot, "2")
    steps = robot.run(release / "install", *options)
    for name, tree in steps[5 :: len(steps) // 4]:
        subprocess.run(["rm", "-rf", robot.root], check=True)
        for path, (kind, it) in sorted(tree.items()):
            place = robot.root / path
            place.parent.mkdir(parents=True, exist_ok=True)
            if kind == "folder":
                place.mkdir(exist_ok=True)
            elif kind == "link":
                place.symlink_to(it)
            else:
                place.write_text(it)
                place.chmod(0o755)
        again = robot.run(release / "install", *options)
        assert robot.boot(again[-1][1]) == whole("2"), name


@pytest.mark.slow
def test_a_calibration_goes_with_the_settings_stays_without_the_option_and_is_taken_over_where_it_was_made_there(
    robot: Robot,
) -> None:
    first = robot.place / "calibration-1"
    first.write_text("calibration 1")
    place = robot.root / "etc/swarm/calibration/r0.toml"
    robot.do(robot.release("1") / "install", *files(robot, "1"), "--calibration", first)
    assert place.is_symlink()
    assert place.read_text() == "calibration 1"
    release = robot.release("2")
    for _, tree in cuts(robot.run(release / "install", *files(robot, "2"))):
        assert robot.read(tree, "etc/swarm/calibration/r0.toml") == "calibration 1"
    place.unlink()
    place.write_text("made here")  # by a program that replaces the link
    robot.do(robot.release("3") / "install", *files(robot, "3"))
    assert place.is_symlink()
    assert place.read_text() == "made here"
    robot.do(robot.root / "../release/uninstall")
    assert not place.is_symlink()
    assert place.read_text() == "made here"


def test_what_uninstall_leaves_are_files_and_not_links_to_what_is_gone(robot: Robot) -> None:
    release = robot.release("1")
    robot.do(release / "install", *files(robot, "1"))
    steps = robot.run(release / "uninstall")
    left = steps[-1][1]
    assert left["etc/swarm/swarm.toml"][0] == left["etc/swarm/key"][0] == "file"
    assert not any("swarm-bus" in path or path.startswith("opt/swarm") for path in left)
    assert steps[-1][0] == "sync"
    for _, tree in cuts(steps):
        assert robot.read(tree, "etc/swarm/swarm.toml") == "config 1"
        assert robot.read(tree, "etc/swarm/key") == "key 1"


def test_an_old_release_that_a_cut_left_half_removed_does_not_count_as_whole(robot: Robot) -> None:
    """Else it could not be installed again."""
    for number in ("1", "2"):
        robot.do(robot.release(number) / "install", *files(robot, number))
    steps = robot.run(robot.release("3") / "install", *files(robot, "3"))
    folder = "opt/swarm/releases/1"
    parts = {path for path in steps[0][1] if path.startswith(folder + "/bin/")}
    assert parts
    assert f"{folder}/complete" in steps[0][1]
    assert folder not in steps[-1][1]
    for count, tree in cuts(steps):
        assert f"{folder}/complete" not in tree or parts <= tree.keys(), count
