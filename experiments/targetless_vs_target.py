"""At what length, motion and texture is a scan as good as a set of board images?

Question: and by how much do 1, 2 or 5 views of a board, in the same graph, shorten that scan?
Method: one simulated stereo rig, calibrated from a scan of N images a camera (0.5 px noise, 5 %
outliers) as `sfm-calib calibrate` does, alone or with views of a board as `--board-images` adds
them; and from N views of a board (54 corners, 0.1 px noise, bent and misprinted as its description
expects) as `sfm-calib target` does. Each is held against the truth: px rms over both pictures
after the best rotation of each camera, focal length, and how the cameras sit. A scan equals the
set of 25 views at the length from which on its px is no larger: those px that its covariance lets
expect, rms over the seeds, for chance makes of the errors of some seeds what it likes. That errors
are as stated is measured too, of boards and of scans. Of these the jackknife is left out: nothing
errs in blocks of frames.
Expectation: by the count of measurements, each weighed by its noise, 25 views of 54 corners are
25 x 54 / 200 x (0.5 / 0.1)^2 = 169 images of 200 features, whatever the motion, to a factor of two.
Source: the usual 20 to 30 images of a board (tutorials of OpenCV and MATLAB); the count is ours.
The same on real images, without a truth: `experiments/board_anchors.py`.
Run: sfm-calib run configs/studies/targetless_vs_target.yaml -o out/targetless_vs_target
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.equal_length import Curve, Equal, equal
from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished, Study
from experiments.targetless_trial import BOARD, TargetlessOptions, trial
from sfm_calib.report.theme import camera_colour

SET_VIEWS = 25  # of the board set that a scan is to equal
FACTOR = 2.0  # to which the count of measurements is expected to hold
FEWEST_SEEDS = 4  # of a length: fewer do not say how far they scatter
# Errors over what is stated of them: beyond it lengths by what is stated are not to be believed.
AS_STATED = (0.8, 1.25)
SHOWN_IMAGES = 50  # at which px are said too

Some = Sequence[Finished[TargetlessOptions]]


@dataclass(frozen=True)
class Kind:
    """One way to calibrate, with all numbers of images."""

    options: TargetlessOptions  # of the first
    trials: tuple[Finished[TargetlessOptions], ...]  # those that went well
    refused: int

    @property
    def name(self) -> str:
        one, usual = self.options, TargetlessOptions()
        if one.source == "boards":
            words = ["board views alone"]
        else:
            words = [f"{one.motion}, {one.features} features"]
            if one.board_views:
                words.append(f"+ {one.board_views} board view{'s' * (one.board_views > 1)}")
            if one.sigma_px != usual.sigma_px:
                words.append(f"{one.sigma_px:g} px")
        if one.corner_sigma_px != usual.corner_sigma_px:
            words.append(f"(corners {one.corner_sigma_px:g} px)")
        return " ".join(words)

    @property
    def images(self) -> tuple[int, ...]:
        return tuple(sorted({one.options.images for one in self.trials}))

    def at(self, images: int) -> list[Finished[TargetlessOptions]]:
        return [one for one in self.trials if one.options.images == images]

    def curve(self, column: str = "px") -> Curve:
        """A column by images and seed; of one that is a list, the rms of its values."""
        found: dict[int, dict[int, float]] = {}
        for one in self.trials:
            value: Any = one.row[column]
            if value is not None:
                rms = float(np.sqrt(np.mean(np.square(value))))
                found.setdefault(one.options.images, {})[one.seed] = rms
        return Curve(found)

    @property
    def fewest(self) -> int:
        """Seeds of a length."""
        return min((len(self.at(images)) for images in self.images), default=0)

    @property
    def counted(self) -> float:
        """Images with as many measurements, weighed by their noise, as the board set."""
        corners = SET_VIEWS * len(BOARD.corners_m)
        noise = self.options.sigma_px / self.options.corner_sigma_px
        return corners / self.options.features * noise**2


@dataclass(frozen=True)
class Equalled:
    """A kind of scan beside the board set: where it equals it by what is stated, and by errors."""

    kind: Kind
    px: Equal
    focal: Equal
    rotation: Equal
    by_errors: Equal  # in px

    @property
    def as_counted(self) -> bool | None:
        """None: the scans tried are too short to be as counted, and do not equal the set either.

        One that equals it at no length tried may at any longer one.
        """
        low, high = self.px.interval
        if high < self.kind.counted / FACTOR:
            return False
        if self.px.longest < self.kind.counted / FACTOR:
            return None
        return min(low, self.px.longest) <= FACTOR * self.kind.counted


def answer(trials: Some) -> Answer:
    """The length at which each kind of scan equals the board set, against what counting says."""
    kinds = kinds_of(trials)
    refused = tuple((_of_one(one), one.seed, one.error) for one in trials if one.error is not None)
    tables = [errors_table(kinds)] if kinds else []
    if refused:
        tables.append(AnswerTable("refused", "Refused", ("trial", "seed", "why"), refused))
    found = [one for kind in kinds if (one := equalled(kind, kinds)) is not None]
    alone = [one for one in found if not one.kind.options.board_views]
    if not alone:
        what = f"no scan and set of {SET_VIEWS} board views among {len(trials)} trials"
        return Answer(f"too little to say: {what} went well", None, tuple(tables))
    errors = errors_over_stated(kinds)
    few = min(kind.fewest for kind in kinds) < FEWEST_SEEDS
    untold = any(not AS_STATED[0] < ratio < AS_STATED[1] for ratio, _ in errors.values())
    told = [said for one in alone if (said := one.as_counted) is not None]
    holds = None if few or untold or not told else all(told)
    begin = {True: "yes", False: "no", None: "scans are too short to say"}[holds]
    if few or untold:
        begin = "too few seeds to say" if few else "errors are not as stated"
    beside = " and ".join(
        f"{ratio:.2f} ± {chance:.2f} (of {what})" for what, (ratio, chance) in errors.items()
    )
    return Answer(
        f"{begin}: {in_words(alone, found, kinds)}; errors are {beside} times as stated",
        holds,
        (equal_table(found), *tables),
        figures(kinds),
    )


def errors_over_stated(kinds: Sequence[Kind]) -> dict[str, tuple[float, float]]:
    """Of boards alone and of scans, for a level is of the one and a length of the other."""
    of_sources = {
        "boards": [kind for kind in kinds if kind.options.source == "boards"],
        "scans": [kind for kind in kinds if kind.options.source == "scan"],
    }
    return {name: _over_stated(some) for name, some in of_sources.items() if some}


def _over_stated(kinds: Sequence[Kind]) -> tuple[float, float]:
    """Of px, rms over all trials, and its standard error: trials of one seed go together."""
    squares: dict[int, list[float]] = {}
    for kind in kinds:
        for one in kind.trials:
            px: Any = one.row["px"]
            stated: Any = one.row["px_stated"]
            squares.setdefault(one.seed, []).append((px / stated) ** 2)
    means = [float(np.mean(some)) for some in squares.values()]
    ratio = float(np.sqrt(np.mean(means)))
    if len(means) < 2:
        return ratio, float("inf")
    return ratio, float(np.std(means, ddof=1)) / len(means) ** 0.5 / (2 * ratio)


def kinds_of(trials: Some) -> list[Kind]:
    """Trials of one kind together, in their order; kinds of which none went well left out."""
    parts: dict[TargetlessOptions, list[Finished[TargetlessOptions]]] = {}
    for one in trials:
        parts.setdefault(one.options.model_copy(update={"images": SET_VIEWS}), []).append(one)
    kinds = []
    for options, some in parts.items():
        well = tuple(one for one in some if one.error is None)
        if well:
            kinds.append(Kind(options, well, len(some) - len(well)))
    return kinds


def _of_one(trial: Finished[TargetlessOptions]) -> str:
    return f"{Kind(trial.options, (), 0).name}, {trial.options.images} images"


def board_set(kinds: Sequence[Kind], corner_sigma_px: float) -> Kind | None:
    """The kind that has the board set of this noise."""
    for kind in kinds:
        one = kind.options
        if one.source == "boards" and one.corner_sigma_px == corner_sigma_px:
            return kind if SET_VIEWS in kind.images else None
    return None


def equalled(kind: Kind, kinds: Sequence[Kind]) -> Equalled | None:
    """None of boards, and where there is no set to equal."""
    boards = board_set(kinds, kind.options.corner_sigma_px)
    if kind.options.source == "boards" or boards is None:
        return None
    columns = ("px_stated", "sigma_focal_percent", "sigma_rotation_deg", "px")
    found = [equal(kind.curve(name), boards.curve(name), SET_VIEWS) for name in columns]
    return Equalled(kind, *found)


# ---- words ---------------------------------------------------------------------------------


def in_words(alone: Sequence[Equalled], found: Sequence[Equalled], kinds: Sequence[Kind]) -> str:
    """The numbers that decide, in one line."""
    boards = board_set(kinds, alone[0].kind.options.corner_sigma_px)
    assert boards is not None
    level = boards.curve("px_stated").rms(SET_VIEWS)
    parts = [
        f"a scan equals {SET_VIEWS} board views ({level:.2f} px) at images (by counting): "
        + ", ".join(f"{one.kind.name} {one.px} ({one.kind.counted:.0f})" for one in alone)
    ]
    joined = [said for one in alone if (said := _with_boards(one, found)) is not None]
    if joined:
        parts.append(f"with board views too: {', '.join(joined)}")
    return "; ".join(parts)


def _with_boards(alone: Equalled, found: Sequence[Equalled]) -> str | None:
    """What views of a board change in scans of a kind; None where there are no such scans."""
    beside = [
        one
        for one in found
        if one.kind.options.board_views
        and one.kind.options.model_copy(update={"board_views": 0}) == alone.kind.options
    ]
    if not beside:
        return None
    views = ", ".join(str(one.kind.options.board_views) for one in beside)
    lengths = [one.px.short for one in beside]
    same = len(set(lengths)) == 1
    said = f"{alone.kind.name} + {views}: {lengths[0] if same else ', '.join(lengths)}"
    curves = [one.kind.curve("px_stated") for one in (alone, *beside)]
    if all(SHOWN_IMAGES in curve.images for curve in curves):
        px = [f"{curve.rms(SHOWN_IMAGES):.2f}" for curve in curves]
        said += f" (of {SHOWN_IMAGES} images {px[0]} px become {', '.join(px[1:])})"
    return said


# ---- tables and figures --------------------------------------------------------------------


def equal_table(found: Sequence[Equalled]) -> AnswerTable:
    """A row a kind of scan."""
    columns = (
        "scan", "motion", "features", "board views", "images", "from", "to", "by errors",
        "errors from", "errors to", "for the focal length", "for the rotation", "by counting",
    )  # fmt: skip
    rows = tuple(
        (
            one.kind.name,
            one.kind.options.motion,
            one.kind.options.features,
            one.kind.options.board_views,
            *_with_interval(one.px),
            *_with_interval(one.by_errors),
            one.focal.short,
            one.rotation.short,
            None if one.kind.options.board_views else one.kind.counted,
        )
        for one in found
    )
    title = f"Images of each camera with which a scan equals {SET_VIEWS} views of a board"
    return AnswerTable("equal", title, columns, rows)


def _with_interval(one: Equal) -> tuple[str, str, str]:
    low, high = one.interval
    return one.short, one.words(low), one.words(high)


MEASURED = (
    ("px", "px", "px_stated"),
    ("focal %", "focal_percent", "sigma_focal_percent"),
    ("rotation deg", "rotation_deg", "sigma_rotation_deg"),
    ("baseline %", "baseline_percent", "sigma_baseline_percent"),
)


def errors_table(kinds: Sequence[Kind]) -> AnswerTable:
    """A row a kind and number of images: rms errors, and what is stated of them."""
    columns = ["from", "images", "trials", "± px"]
    for title, _, _ in MEASURED:
        columns += [title, f"{title} stated"]
    rows = []
    for kind in kinds:
        of = {name: kind.curve(name) for _, *names in MEASURED for name in names}
        for images in kind.images:
            values = [
                of[name].rms(images) if images in of[name].images else None
                for _, *names in MEASURED
                for name in names
            ]
            chance = of["px"].rms_error(images)
            rows.append((kind.name, images, len(kind.at(images)), chance, *values))
    title = "RMS errors, and what the covariances let expect of them"
    return AnswerTable("errors", title, tuple(columns), tuple(rows))


def figures(kinds: Sequence[Kind]) -> tuple[AnswerFigure, ...]:
    """Error over the number of images: scans alone, and with board views beside them."""
    boards = [kind for kind in kinds if kind.options.source == "boards"]
    scans = [kind for kind in kinds if kind.options.source == "scan"]
    alone = [kind for kind in scans if not kind.options.board_views]
    joined = {(one.options.motion, one.options.features) for one in scans if one not in alone}
    parts = [("alone", "Scans alone", [*boards, *alone])]
    for motion, features in sorted(joined):
        some = [s for s in scans if (s.options.motion, s.options.features) == (motion, features)]
        title = f"With views of a board: {motion}, {features} features"
        parts.append((f"with_boards_{motion}_{features}", title, [*boards, *some]))
    return tuple(_figure(name, title, some) for name, title, some in parts)


def _figure(name: str, title: str, kinds: Sequence[Kind]) -> AnswerFigure:
    series, dots = [], []
    for kind in kinds:
        stated, curve = kind.curve("px_stated"), kind.curve()
        level = [stated.rms(n) for n in stated.images]
        series.append(Series(kind.name, stated.images, level))
        dots.append((curve.images, [curve.rms(n) for n in curve.images]))
    boards = board_set(kinds, kinds[0].options.corner_sigma_px)
    at = None if boards is None else boards.curve("px_stated").rms(SET_VIEWS)
    figure = lines(series, "images of each camera", "px rms", True, True, at, 460)
    for index, (images, px) in enumerate(dots):
        marker = {"color": camera_colour(index), "symbol": "x-thin-open", "size": 8}
        figure.add_scatter(x=images, y=px, mode="markers", marker=marker, showlegend=False)
    caption = (
        f"Error over both pictures: lines as stated, crosses as it was. Dotted: {SET_VIEWS} views "
        "of a board alone; a scan equals them where its line crosses that."
    )
    return AnswerFigure(name, title, caption, figure)


STUDY = Study(TargetlessOptions, trial, answer)
