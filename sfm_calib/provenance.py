"""What made a result, when, and what it takes the place of."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, Field

from sfm_calib.record import Record

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


def to_the_second(moment: datetime) -> datetime:
    """In UTC, without the fraction of a second."""
    return moment.astimezone(UTC).replace(microsecond=0)


def now() -> datetime:
    """The moment of writing, as `Provenance.created` has it."""
    return to_the_second(datetime.now(UTC))


class Replaced(Record):
    """The calibration that a result takes the place of."""

    path: str  # as it was given
    sha256: Sha256  # `sfm_calib.files.calibration_sha256`


class Provenance(Record):
    """What made the result: enough to make it again."""

    version: str
    versions: dict[str, str] = Field(default_factory=dict)
    command: str = ""
    config: dict[str, object] = Field(default_factory=dict)
    seed: int = 0
    input_hashes: dict[str, str] = Field(default_factory=dict)
    # When it was written, UTC; None: an older file, or a simulation's truth.
    created: Annotated[AwareDatetime, AfterValidator(to_the_second)] | None = None
    replaces: Replaced | None = None
    pixel_convention: Literal["OpenCV: the centre of the top-left pixel is (0, 0)"] = (
        "OpenCV: the centre of the top-left pixel is (0, 0)"
    )
