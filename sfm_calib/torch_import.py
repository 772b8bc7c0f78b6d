"""torch and kornia, which are an extra: imported where they are needed, and missed in one line."""

from __future__ import annotations

from typing import Any, Literal

from sfm_calib.errors import CalibrationError

Device = Literal["cpu", "cuda"]
REMEDY = "torch and kornia: pip install 'sfm_calib[learned]'"


def import_torch(device: Device | str = "cpu", purpose: str = "--refine") -> Any:
    """The torch module. Raises CalibrationError when it, kornia or the device is missing.

    purpose: what cannot be done without, as the message begins.
    """
    try:
        import kornia.filters  # noqa: F401
        import torch
    except (ImportError, OSError) as error:  # OSError: a library that it needs is missing
        raise CalibrationError(f"{purpose} needs {REMEDY} ({error})") from error
    if device == "cuda" and not torch.cuda.is_available():
        raise CalibrationError(
            "--device cuda: torch finds no GPU here; install a torch built for it, or leave it out"
        )
    return torch
