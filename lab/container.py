"""A Debian root booted under systemd in a container, to run one script in it; quicker than a machine."""

import subprocess
from pathlib import Path

UNIT = """[Unit]
After=multi-user.target
[Service]
Type=exec
ExecStart=/bin/sh -c '/bin/sh /lab-script >/lab-output 2>&1; echo $? >/lab-code; systemctl poweroff --no-block'
"""


def boot(root: Path, script: str, seconds: float) -> tuple[int, str]:
    """Boot that root, run the script as its root when all is up, and power off: exit code and output.

    Raises subprocess.TimeoutExpired; `FileNotFoundError` where the container ended before its script did.
    """
    system = root / "etc/systemd/system"
    wants = system / "default.target.wants"
    wants.mkdir(exist_ok=True)
    link, unit = wants / "lab-script.service", system / "lab-script.service"
    unit.write_text(UNIT)
    link.unlink(missing_ok=True)
    link.symlink_to("/etc/systemd/system/lab-script.service")
    files = [root / name for name in ("lab-script", "lab-output", "lab-code")]
    files[0].write_text(script)
    nspawn = ["systemd-nspawn", f"--directory={root}", "--register=no", "--keep-unit", "--private-network", "-q", "-b"]
    try:
        subprocess.run(nspawn, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, check=False)
        return int(files[2].read_text()), files[1].read_text()
    finally:
        for file in (*files, link, unit):
            file.unlink(missing_ok=True)
