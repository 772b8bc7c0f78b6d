"""Torch and kornia, which are an extra: imported where they are needed, and missed in one line."""

from __future__ import annotations

import importlib
import importlib.util
from importlib.metadata import version
from typing import Any, Literal

from graphs.threads import thread_count
from sfm_calib.errors import CalibrationError

Device = Literal["cpu", "cuda"]
PACKAGES = ("torch", "kornia")
TORCH_REMEDY = "needs torch and kornia: pip install 'sfm_calib[learned]'"


def check_torch(purpose: str) -> None:
    """Raises CalibrationError where torch or kornia is not installed; imports neither.

    purpose: what cannot be done without, as the message begins.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise CalibrationError(f"{purpose} {TORCH_REMEDY} (no module {missing[0]})")


def torch_versions() -> dict[str, str]:
    """Which torch and kornia are installed, without importing them."""
    return {name: version(name) for name in PACKAGES}


def import_torch(purpose: str, device: Device = "cpu") -> Any:
    """The torch module, as many threads as we may use.

    Raises CalibrationError when it or kornia is missing, or `device` is not there.
    """
    check_torch(purpose)
    torch = _imported("torch", purpose)
    if device == "cuda" and not torch.cuda.is_available():
        raise CalibrationError(
            "device cuda: torch finds no GPU that it can use here; leave --device out, or install "
            "a CUDA build of torch and the driver"
        )
    torch.set_num_threads(thread_count())
    return torch


def import_kornia(module: str, purpose: str) -> Any:
    """A module of kornia, as "feature". Raises CalibrationError when it, or torch, is missing."""
    check_torch(purpose)
    return _imported(f"kornia.{module}", purpose)


def _imported(module: str, purpose: str) -> Any:
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: a system library is missing
        cause = str(error).splitlines()[0]
        raise CalibrationError(f"{purpose} {TORCH_REMEDY} ({cause})") from error
