"""Where the thesis' recordings are, which are no part of this repository."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3].parent / "shared/thesis-data")

needs_calibration = pytest.mark.skipif(
    not (DATA / "calibration" / "full.csv").is_file(),
    reason=f"the thesis' calibration recording is not in {DATA}/calibration (SWARM_THESIS_DATA names the folder)",
)
needs_localization = pytest.mark.skipif(
    not (DATA / "localization" / "test_2").is_dir(),
    reason=f"the thesis' localization recordings are not in {DATA}/localization (SWARM_THESIS_DATA names the folder)",
)


def calibration_samples():
    from services.dwm.core.calibration import samples

    path = DATA / "calibration" / "full.csv"
    return samples.read(path.read_text(), str(path), samples.THESIS_PLACES)
