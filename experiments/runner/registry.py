"""The studies there are: the files under experiments/ that have a STUDY."""

from __future__ import annotations

import importlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from experiments.runner.protocol import Study
from sfm_calib.errors import nearest

HERE = Path(__file__).parent.parent


@cache
def studies() -> tuple[str, ...]:
    """Their names, in order."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(HERE.glob("*.py"))}
    return tuple(name for name, text in texts.items() if re.search(r"^STUDY\b", text, re.MULTILINE))


def check_name(name: str) -> None:
    """Raises ValueError with the nearest valid name."""
    if name not in studies():
        raise ValueError(f"there is no study {name!r}; {nearest(name, studies())}")


def study_of(name: str) -> Study[Any]:
    """The study in experiments/NAME.py; its docstring is `about(name)`."""
    study: Study[Any] = importlib.import_module(f"experiments.{name}").STUDY
    return study


def about(name: str) -> str:
    """Question, method, expectation and source, as the study's file says them."""
    return (importlib.import_module(f"experiments.{name}").__doc__ or "").strip()
