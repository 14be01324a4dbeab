"""The lab's Debian: a root of a few packages."""

import shutil
from pathlib import Path

from lab.vm import recipe
from lab.vm.shell import sh


def make(folder: Path, mirror: str) -> None:
    """root.tar, and `packages` with what it is made of."""
    root = folder / "root"
    drop = [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in ("doc", "man", "locale")]
    include = f"--include={','.join(recipe.PACKAGES)}"
    options = ["--quiet", "--variant=minbase", include, *drop, "--dpkgopt=force-unsafe-io"]
    languages = "--aptopt=Acquire::Languages none"
    sh("mmdebstrap", *options, languages, recipe.SUITE, root, mirror, SOURCE_DATE_EPOCH=recipe.EPOCH)
    (folder / "packages").write_text(sh("dpkg-query", f"--admindir={root}/var/lib/dpkg", "--show"))
    sh("tar", "-C", root, "--sort=name", f"--mtime=@{recipe.EPOCH}", "--numeric-owner", "-cf", folder / "root.tar", ".")
    shutil.rmtree(root)
