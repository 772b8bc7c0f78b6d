"""Files written by hand, and the one line with which a bad one is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def refused(path: Path) -> str:
    with pytest.raises(CalibrationError) as caught:
        read_calibration(path)
    message = str(caught.value)
    assert "\n" not in message
    return message
