"""The conclusion of a comparison, in words that claim no more than the numbers do."""

from __future__ import annotations

from collections.abc import Iterator

from sfm_calib.compare_record import (
    Chance,
    Comparison,
    ComparisonVerdict,
    Kind,
    PairDifference,
    ParameterDifference,
    ProjectionDifference,
)
from sfm_calib.report.digits import short

SURPRISING = (
    0.01  # probability below which chance does not explain a difference, as of split halves
)
SELDOM = 0.05  # neither chance nor not: said beside the conclusion
SAME_PX, SAME_PERCENT = 0.01, 0.01  # below: files that round, not calibrations that differ
LEAST_PX = 1e-3  # no image shows less
LITTLE_PX = 0.1  # as well as features are located at best
NOTICED_PX = 1.0  # rms: rectified lines of a stereo pair miss each other
# Of the difference, outside of what the sigmas reach: this part of what they let expect is
# curvature (0.003 of 4 px in made pairs).
OUTSIDE_SHARE = 0.1
LARGE_Z = 3.0
SHIFTED_PX = 1.0  # a principal point that is off by less needs no word
HIDDEN_SHARE = 0.25  # of the shift, left in the picture
LEAST_LOST = 0.005  # of the common view: the edge of two lenses
TYPICAL_RANGE = 5.0  # at which pairs are ranked by what their depths lose


def verdict_of(record: Comparison) -> ComparisonVerdict:
    """The main line first, then what is hidden, depths, and what no sigma reaches."""
    kind = _kind(record)
    lines = [_headline(kind, record)]
    if kind != "same":
        lines += [*_hidden(record), *_picture(record), *_depths(record)]
    return ComparisonVerdict(kind=kind, lines=tuple(lines))


def _kind(record: Comparison) -> Kind:
    depths = [d.worst_percent for pair in record.pairs for d in pair.depth]
    most_percent = max((abs(d) for d in depths if d is not None), default=0.0)
    lost = any(d.no_depth_share for pair in record.pairs for d in pair.depth)
    if _largest_px(record) < SAME_PX and most_percent < SAME_PERCENT and not lost:
        return "same"
    if (chance := record.chance) is None:
        return "no sigmas"
    if not chance.rank:
        return "cannot tell"
    if chance.p_value <= SURPRISING or _is_outside(chance):
        return "differ"
    return "cannot tell" if chance.difference_px > NOTICED_PX else "agree"


def _is_outside(chance: Chance) -> bool:
    """Whether much of the difference lies where no sigma reaches."""
    return chance.outside_px > max(LITTLE_PX, OUTSIDE_SHARE * chance.expected_px)


def _headline(kind: Kind, record: Comparison) -> str:
    chance, who = record.chance, _who(record)
    if kind == "same":
        return f"The two are the same: no pixel differs by as much as {SAME_PX:g} px"
    if chance is None:
        return _without_sigmas(record)
    p, rms, left = p_text(chance), px_text(chance.difference_px), px_text(chance.expected_px)
    if kind == "agree":
        agree = (
            f"agree, if only just: noise seldom explains as much ({p})"
            if chance.p_value < SELDOM
            else f"agree: nothing differs by more than noise explains ({p})"
        )
        return (
            f"The two {agree}; they lie {rms} rms apart in the picture, and their sigmas let "
            f"expect {left}"
        )
    if not chance.rank:
        return (
            f"{who}: the sigmas are so large ({left} rms in the picture) that the "
            f"difference of {rms} says nothing about chance"
        )
    if kind == "cannot tell":
        return (
            f"{who}: they lie {rms} rms apart in the picture, and the sigmas let "
            f"expect {left} ({p}{', chance seldom does as much' * (chance.p_value < SELDOM)})"
        )
    if chance.p_value > SURPRISING:
        return (
            f"They differ where no sigma reaches, by {px_text(chance.outside_px)} rms: another "
            f"lens model, or parameters that were held. What the sigmas cover agrees ({p})"
        )
    if chance.difference_px < LITTLE_PX:
        return (
            f"They differ by more than their sigmas explain ({p}), but by little: {rms} rms in the "
            "picture"
        )
    return f"They differ: {_what(record)}; {rms} rms in the picture, {left} expected ({p})"


def _who(record: Comparison) -> str:
    states = record.a.states_sigmas, record.b.states_sigmas
    return "Neither can tell" if all(states) else f"{'A' if states[0] else 'B'} cannot tell"


def _without_sigmas(record: Comparison) -> str:
    far = max(one.rms_px for told in record.projection.values() for one in told)
    why = (
        "neither states sigmas"
        if not (record.a.states_sigmas or record.b.states_sigmas)
        else "no sigma can be trusted in the picture"
    )
    so = "practically the same in the picture" if far < LITTLE_PX else "apart in the picture"
    return f"They are {so}, up to {px_text(far)} rms; {why}: whether by chance cannot be said"


def _what(record: Comparison) -> str:
    """The parameter that differs most in sigmas, where one does."""
    rows = [row for row in record.parameters if row.z is not None]
    worst = max(rows, key=lambda row: abs(row.z or 0.0), default=None)
    if worst is None or worst.z is None or abs(worst.z) < LARGE_Z:
        return "all parameters together, none by itself"
    camera, _, parameter = worst.name.rpartition(".")
    return f"{parameter} of {camera} by {_size(worst)} ({abs(worst.z):.1f} combined sigmas)"


def _size(row: ParameterDifference) -> str:
    return f"{short(abs(row.difference))} {row.unit}".rstrip()


# ---- in the picture ------------------------------------------------------------------------


def _hidden(record: Comparison) -> Iterator[str]:
    """Principal points that moved, and a rotation that undoes it."""
    turn = "a rotation hides" if record.unit is None else "how the cameras are turned hides"
    by_name = {row.name: row.difference for row in record.parameters}
    for name, told in record.projection.items():
        shift = float(abs(by_name[f"{name}.cx"] + 1j * by_name[f"{name}.cy"]))
        left = max(one.rms_px for one in told)
        if shift >= SHIFTED_PX and left <= HIDDEN_SHARE * shift:
            yield (
                f"the principal point of {name} is {px_text(shift)} off, but {turn} all but "
                f"{px_text(left)} (rms) of it"
            )


def _picture(record: Comparison) -> Iterator[str]:
    """rms in the picture of the camera that differs most, at every range."""
    name, told = max(record.projection.items(), key=lambda entry: _worst_rms(entry[1]))
    if record.unit is None:
        yield (
            f"in the picture {px_text(told[0].rms_px)} rms and up to {px_text(told[0].max_px)} "
            f"({name}{_most(record)}), after the best rotation"
        )
        return
    fitted = (
        "turn, shift and scale of the rig"
        if record.taken_out[0].scale
        else ("turn and shift of the rig")
    )
    sizes = " / ".join(short(one.rms_px) for one in told)
    places = " / ".join("infinity" if one.range is None else f"{one.range:g}" for one in told)
    yield (
        f"in the picture {sizes} px rms at {places} {_unit(record)} ({name}{_most(record)}), "
        f"after the best {fitted}"
    )


def _most(record: Comparison) -> str:
    return ", which differs most" if len(record.projection) > 1 else ""


def _worst_rms(told: tuple[ProjectionDifference, ...]) -> float:
    return max(one.rms_px for one in told)


def _largest_px(record: Comparison) -> float:
    return max(one.max_px for told in record.projection.values() for one in told)


# ---- in depths -----------------------------------------------------------------------------


def _depths(record: Comparison) -> Iterator[str]:
    """Depths of the pair that loses most, at every range."""
    if not record.pairs:
        return
    pair = max(record.pairs, key=_lost)
    told = [one for one in pair.depth if one.median_percent is not None]
    if not told:
        yield "no two cameras share a view: nothing is said of depths"
        return
    sizes = " / ".join(_percent(one.median_percent or 0.0) for one in told)
    places = " / ".join(f"{one.range:g}" for one in told)
    more = " of all pairs the most" if len(record.pairs) > 1 else ""
    yield (
        f"depths by A where B is true: {sizes} % at {places} {_unit(record)} (median over the "
        f"common view of {pair.cameras[0]} and {pair.cameras[1]}{',' if more else ''}{more})"
    )
    lost = max(one.no_depth_share for one in pair.depth)
    if lost > LEAST_LOST:
        yield f"for {lost:.0%} of their common view A finds no depth at all: its rays do not meet"


def _lost(pair: PairDifference) -> float:
    """Median error in size at about TYPICAL_RANGE; -1 where there is none."""
    told = [one for one in pair.depth if one.median_percent is not None]
    nearest = min(told, key=lambda one: abs(one.range - TYPICAL_RANGE), default=None)
    return -1.0 if nearest is None else abs(nearest.median_percent or 0.0)


# ---- numbers -------------------------------------------------------------------------------


def _unit(record: Comparison) -> str:
    return "baselines" if record.unit == "baseline" else "m"


def px_text(value: float) -> str:
    """Pixels with two digits, down to a thousandth."""
    return f"{short(value)} px" if value >= LEAST_PX else f"less than {LEAST_PX:g} px"


def _percent(value: float) -> str:
    sign = "+" if value > 0 else "-" if value < 0 else ""
    return sign + short(float(f"{abs(value):.2g}"))  # 0.998 as 1.0, like its neighbours


def p_text(chance: Chance) -> str:
    """The p-value with two digits."""
    return "p < 0.0001" if chance.p_value < 1e-4 else f"p = {chance.p_value:.2g}"
