"""The lab's Debian: a root of a few packages, a kernel beside it, and a RAM disk that brings both together."""

import gzip
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lab.vm import recipe
from swarm.errors import LocalError


def sh(*words: object, **more: str) -> str:
    """Run a command, with more of an environment; its output. `LocalError` with what it said where it fails."""
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, env={**os.environ, **more}, check=False
    )
    if done.returncode:
        raise LocalError(f"{words[0]} failed with {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout


def make(folder: Path, mirror: str) -> None:
    """root.tar with the kernel's modules in it, vmlinuz, initrd.gz, and `packages` with what they are made of."""
    kernel, root = folder / "kernel", folder / "root"
    with ThreadPoolExecutor() as pool:
        made = pool.submit(_kernel, kernel, mirror)
        drop = [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in ("doc", "man", "locale")]
        include = f"--include={','.join(recipe.PACKAGES)}"
        options = ["--quiet", "--variant=minbase", include, *drop, "--dpkgopt=force-unsafe-io"]
        languages = "--aptopt=Acquire::Languages none"
        sh("mmdebstrap", *options, languages, recipe.SUITE, root, mirror, SOURCE_DATE_EPOCH=recipe.EPOCH)
        version = made.result()
    shutil.copy(kernel / f"boot/vmlinuz-{version}", folder / "vmlinuz")
    _modules(kernel, root, version)
    _ramdisk(folder, kernel, version)
    (folder / "packages").write_text(sh("dpkg-query", f"--admindir={root}/var/lib/dpkg", "--show") + version + "\n")
    sh("tar", "-C", root, "--sort=name", f"--mtime=@{recipe.EPOCH}", "--numeric-owner", "-cf", folder / "root.tar", ".")
    shutil.rmtree(kernel)
    shutil.rmtree(root)


def _kernel(folder: Path, mirror: str) -> str:
    """The kernel's package unpacked in that folder, its modules' dependencies worked out; its version."""
    sh("mmdebstrap", "--quiet", "--variant=extract", "--include=linux-image-amd64", recipe.SUITE, folder, mirror)
    if not (folder / "lib").exists():
        (folder / "lib").symlink_to("usr/lib")
    (version,) = [path.name for path in (folder / "usr/lib/modules").iterdir()]
    sh("depmod", "-b", folder, version)
    return version


def _closure(kernel: Path, version: str, modules: tuple[str, ...]) -> list[Path]:
    """Files of these modules after those that they depend on, each once."""
    found: dict[Path, None] = {}
    for module in modules:
        said = sh("modprobe", "-d", kernel, "-S", version, "--show-depends", module)
        for line in said.splitlines():
            if line.startswith("insmod "):
                found[Path(line.split()[1])] = None
    return list(found)


def _unpacked(file: Path, to: Path) -> None:
    """A module, stored unpacked and without signature and types, each of which takes seconds in an emulated machine."""
    to.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".xz":
        to = to.with_suffix("")
        with to.open("wb") as out:
            subprocess.run(["xz", "-dc", str(file)], stdout=out, check=True)
    else:
        shutil.copy(file, to)
    sh("objcopy", "--strip-debug", "--remove-section=.BTF", to)


def _modules(kernel: Path, root: Path, version: str) -> None:
    tree = kernel / "lib/modules" / version
    wanted = [file.relative_to(tree) for file in _closure(kernel, version, recipe.MODULES)]
    for part in ("kernel/crypto", "kernel/arch/x86/crypto"):
        wanted += [file.relative_to(tree) for file in (tree / part).rglob("*.ko*")]
    target = root / "usr/lib/modules" / version
    for file in wanted:
        _unpacked(tree / file, target / file)
    for name in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
        shutil.copy(tree / name, target / name)
    sh("depmod", "-b", root, version)


def _ramdisk(folder: Path, kernel: Path, version: str) -> None:
    work = folder / "ramdisk"
    for name in ("bin", "modules", "proc", "sys", "dev", "newroot"):
        (work / name).mkdir(parents=True)
    shutil.copy(shutil.which("busybox") or "busybox", work / "bin/busybox")
    shutil.copy(recipe.GUEST / "boot", work / "init")
    (work / "init").chmod(0o755)
    files = _closure(kernel, version, recipe.BOOT_MODULES)
    for file in files:
        _unpacked(file, work / "modules" / file.name)
    (work / "modules/list").write_text("".join(file.name.removesuffix(".xz") + "\n" for file in files))
    names = "\n".join(sorted(str(path.relative_to(work)) for path in work.rglob("*")))
    packed = subprocess.run(
        ["cpio", "-o", "-H", "newc", "--quiet", "--reproducible"],
        input=names.encode(), cwd=work, capture_output=True, check=True,
    )  # fmt: skip
    (folder / "initrd.gz").write_bytes(gzip.compress(packed.stdout, 1, mtime=0))
    shutil.rmtree(work)
