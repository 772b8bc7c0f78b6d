"""The report's account of its sigmas: what they are made of, what is weak, and which lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_report import Case, Page, calibration_of, scene

from sfm_calib.report.checks import checks_of
from sfm_calib.report.headline import banner
from sfm_calib.report.lens_ladder import lens_ladder
from sfm_calib.report.noise import noise_figure, noise_panel
from sfm_calib.report.page import render
from sfm_calib.report.residuals import residuals_by_camera, summary
from sfm_calib.report.rows import baseline_sigma, camera_tables, rig_tables
from sfm_calib.report.sigmas import ratio_figure, sigma_section
from sfm_calib.report.weak import marks_of, weak_cards
from sfm_calib.result import (
    OF_LENS,
    Calibration,
    Certificate,
    LensChoice,
    Noise,
    NoiseBySize,
    Rung,
    Sigmas,
    Split,
    Verdict,
    WeakDirection,
)

ODD = "<img src=x>"
HALVES = Split(difference_px=1.4, expected_px=3.21, p_value=0.73, agrees=True)
TWINS = Certificate(
    trials=4, failed=0, nees=1.2, nees_standard_error=0.12, model_nees=2.5, coverage=0.94,
    least_covered=f"{ODD}.k2", least_coverage=0.75, holds=True,
)  # fmt: skip
WEAK = WeakDirection(
    what=f"cx of left and {ODD}",
    effect_px=1.3,
    remedy="roll the rig",
    parameters=(f"{ODD}.cx", "left.p2", f"{ODD}.rotation_y", f"{ODD}.translation_z"),
    moves=(-2.43, 0.00094, np.radians(0.05), -0.021),
    slide_px=3.5,
    data_slide_px=7.2,
    effect_centre_px=0.11,
    effect_corner_px=1.3,
    prior_share=0.06,
)
LENS = WeakDirection(
    what=f"k1 of left: which lens it is, {ODD}",
    effect_px=4.7,
    remedy="say it",
    kind=OF_LENS,
    parameters=("left.k1", "left.cx"),
    moves=(-0.01, 1.5),
)


def sigmas_of(calibration: Calibration) -> dict[str, Sigmas]:
    """Jackknife and stated sigma twice and three times the model's, one parameter held."""
    names = calibration.covariance.names
    some = {n: Sigmas(model=0.1, robust=0.15, jackknife=0.2, stated=0.3) for n in names}
    return some | {"left.p1": Sigmas(model=0.0, robust=0.0, jackknife=0.0, stated=0.0)}


def sizes() -> tuple[NoiseBySize, ...]:
    ends = ((0.8, 1.6, 1234, 0.2), (1.6, 6.4, 400, 0.52))
    return tuple(
        NoiseBySize(smallest_px=a, largest_px=b, n_observations=n, sigma_px=s)
        for a, b, n, s in ends
    )


def rung(lens: str = "radtan", **changes: object) -> Rung:
    said = {
        "lens": lens, "held_out_px": 0.5431, "against": 0, "gain_px": 0.0231, "gain_sigmas": 4.1,
        "shift_focal_px": 11.0, "shift_centre_px": 3.5,
        "sigma": {"left.fx": 2.0, f"{ODD}.fx": 3.5, "left.cx": 2.5},
        "weak": (f"cx of {ODD}", "k1"), "verdict": "taken",
    }  # fmt: skip
    return Rung.model_validate(said | changes)


CHOICE = LensChoice(
    chosen=1,
    reason=f"radtan: predicts {ODD} best",
    n_frames=50,
    n_observations=18036,
    rungs=(
        rung("simple_radial", weak=(), verdict="the first rung", gain_px=0.0, sigma={}),
        rung(),
        rung("brown", held=("p1", "p2"), against=1, verdict="no better", gain_px=-0.0088),
    ),
)


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(0)
    problem, estimate = scene(("left", ODD), rng, n_frames=4, n_points=60)
    calibration = calibration_of(problem, estimate, rng)
    noise = Noise(
        sigma_px=0.4,
        inflation=3.0,
        sigmas=sigmas_of(calibration),
        by_size={"left": sizes(), ODD: sizes()[:1]},
    )
    verdict = Verdict(usable=True, weak=(WEAK, LENS), split=HALVES, certificate=TWINS)
    told = {"noise": noise, "verdict": verdict, "lens_choice": CHOICE}
    return calibration.model_copy(update=told), problem, estimate


def judged(calibration: Calibration, **changes: object) -> Calibration:
    verdict = Verdict(usable=True).model_copy(update=changes)
    return calibration.model_copy(update={"verdict": verdict})


def test_everything_is_on_the_page_and_escaped(case: Case) -> None:
    text = render(*case)
    page = Page(text)
    keys = {a["id"] for _, a in page.tags if "id" in a}
    assert {"weak", "ladder", "sigmas", "sigma-ratios", "noise-by-size"} <= keys
    for said in (
        "they project 1.40 px apart (rms), and their sigmas predict 3.21 px (p = 0.73): they agree",
        f"hold 94 % of the truths ({ODD}.k2: 3 of 4): the sigmas hold",
        f"cx of left and {ODD}",
        f"{ODD}.cx ± 2.4 px",
        "free by 3.5 px, which shows as 0.11 px at the centre and 1.3 px in a corner",
        f"radtan: predicts {ODD} best",
        "brown without p1, p2",
        "Here stated sigmas are 3.0 times those of noise alone.",
    ):
        assert said in page.text
    assert "<img" not in text and not any(tag == "img" for tag, _ in page.tags)
    assert any(a.get("title") == WEAK.what for _, a in page.tags)
    assert "\\u003cimg" not in text  # in plotly's JSON either


def test_without_them_the_page_is_whole(case: Case) -> None:
    calibration, problem, estimate = case
    old = {"noise": Noise(sigma_px=0.4), "lens_choice": None, "verdict": Verdict(usable=True)}
    text = render(calibration.model_copy(update=old), problem, estimate)
    for key in ("weak", "ladder", "sigmas"):
        assert f'id="{key}"' not in text and f'href="#{key}"' not in text
    assert 'class="checks"' not in text
    bare = {"noise": None, "lens_choice": None, "verdict": None}
    assert 'id="sigmas"' not in render(calibration.model_copy(update=bare), problem, estimate)


def test_sigmas_share_their_digits_and_angles_are_in_degrees(case: Case) -> None:
    calibration = case[0]
    section = sigma_section(calibration)
    assert section is not None and section.opened and section.has_jackknife
    left, other = section.tables
    assert (left.name, other.name) == ("left", ODD)
    fx, p1 = left.rows[0], next(row for row in left.rows if row.label == "p1")
    assert (fx.model, fx.robust, fx.jackknife, fx.stated) == ("0.10", "0.15", "0.20", "0.30")
    assert (fx.ratio, fx.unit) == ("× 3.0", "px")
    assert (p1.model, p1.stated, p1.ratio) == ("–", "held fixed", "–")
    turn = next(row for row in other.rows if row.label == "rotation y")
    assert (turn.model, turn.unit) == ("5.7", "°")
    assert next(row for row in other.rows if row.label == "translation z").unit == "m"


def test_a_scan_too_short_for_a_jackknife_says_so(case: Case) -> None:
    calibration, problem, estimate = case
    one = Sigmas(model=0.1, robust=0.15, stated=0.15)
    noise = Noise(sigma_px=0.4, sigmas={"left.fx": one})
    short = calibration.model_copy(update={"noise": noise})
    section = sigma_section(short)
    assert section is not None and not section.has_jackknife
    assert section.tables[0].rows[0].jackknife == "–"
    assert "too few frames for it" in render(short, problem, estimate)
    assert [trace.name for trace in ratio_figure(noise.sigmas).data] == ["robust", "stated"]
    held = Noise(sigma_px=0.4, sigmas={"left.fx": Sigmas(model=0.0, robust=0.0, stated=0.0)})
    nothing = sigma_section(calibration.model_copy(update={"noise": held}))
    assert nothing is not None and nothing.ratios is None


def test_noise_by_size(case: Case) -> None:
    calibration = case[0]
    panel = noise_panel(calibration)
    assert panel is not None
    assert "left: from 0.20 px to 0.52 px." in panel.caption
    assert f"{ODD}: 0.20 px for all." in panel.caption
    left = noise_figure({"left": sizes()}).data[0]
    np.testing.assert_allclose(left.x, [np.sqrt(0.8 * 1.6), 3.2], rtol=1e-6)
    assert tuple(left.customdata[0]) == ("0.8 to 1.6", "1,234")
    unknown = NoiseBySize(smallest_px=None, largest_px=None, n_observations=9, sigma_px=0.4)
    noise = Noise(sigma_px=0.4, by_size={"left": (unknown,), ODD: ()})
    assert noise_panel(calibration.model_copy(update={"noise": noise})) is None


def test_the_ladder_compares_each_rung(case: Case) -> None:
    ladder = lens_ladder(case[0])
    assert ladder is not None and [row.chosen for row in ladder.rows] == [False, True, False]
    first, taken, last = ladder.rows
    assert (first.gain, first.against, first.centre, first.sigma_fx) == ("–",) * 4
    assert (taken.gain, taken.gain_sigmas, taken.against) == ("+0.0231", "+4.1", "simple_radial")
    assert (taken.sigma_fx, taken.sigma_cx, taken.focal, taken.centre) == (
        "3.5", "2.5", "11.0", "3.5"
    )  # fmt: skip
    assert (last.lens, last.against, last.gain) == ("brown without p1, p2", "radtan", "-0.0088")
    unjudged = CHOICE.model_copy(update={"rungs": (CHOICE.rungs[0], rung(held_out_px=None))})
    ladder = lens_ladder(case[0].model_copy(update={"lens_choice": unjudged}))
    assert ladder is not None
    row = ladder.rows[1]
    assert (row.held_out, row.gain, row.focal) == ("–", "–", "11.0")


def test_weak_directions_tell_how_far_they_go(case: Case) -> None:
    weak, lens = weak_cards(case[0])
    assert weak.moves == (
        f"{ODD}.cx ± 2.4 px",
        "left.p2 ± 0.00094",
        f"{ODD}.rotation_y ± 0.050°",
        f"{ODD}.translation_z ± 0.021 m",
    )
    assert weak.without_priors == "Without priors it would be free by 7.2 px."
    assert lens.moves == ("left.k1 by -0.010", "left.cx by 1.5 px")
    assert (lens.mover, lens.without_priors) == ("that lens", "")
    blind = WEAK.model_copy(update={"data_slide_px": None})
    (card,) = weak_cards(judged(case[0], weak=(blind,)))
    assert card.without_priors == "Without priors the scan says nothing of it."


def test_weak_parameters_are_marked_in_their_tables(case: Case) -> None:
    calibration = judged(case[0], weak=(LENS, WEAK.model_copy(update={"parameters": ("left.cx",)})))
    words = {name: [m.word for m in marks] for name, marks in marks_of(calibration).items()}
    assert words == {"left.k1": ["lens"], "left.cx": ["lens", "weak"]}
    left, _ = camera_tables(calibration)
    cx = next(row for row in left.rows if row.label == "cx")
    assert [mark.why for mark in cx.marks] == [LENS.what, WEAK.what]
    assert cx.prior_decides  # a flag of its own
    (rig,) = rig_tables(case[0])
    marked = [row.label for row in rig.rows if row.marks]
    assert marked == ["rotation y", "translation z"]


def test_what_was_held_rests_on_no_prior(case: Case) -> None:
    calibration, problem, estimate = case
    left = calibration.cameras["left"]
    changes = {"sigma": left.sigma | {"cx": 0.0}, "prior_share": {"cx": 1.0, "fy/fx": 0.9}}
    cameras = calibration.cameras | {"left": left.model_copy(update=changes)}
    held = calibration.model_copy(update={"cameras": cameras})
    table = camera_tables(held)[0]
    cx = next(row for row in table.rows if row.label == "cx")
    assert cx.held and not cx.prior_decides
    assert table.caption.endswith("; fy/fx is decided mostly by the prior")
    assert "not estimated" in render(held, problem, estimate)


def test_the_banner_fits_what_was_found(case: Case) -> None:
    calibration = case[0]
    good = banner(judged(calibration))
    assert good.tone == "good" and "2 parameters are decided" in good.explanation  # both cx
    weak = banner(judged(calibration, weak=(WEAK,)))
    assert weak.tone == "doubtful"
    assert weak.explanation == (
        "The scan left one direction weakly determined: one sigma shows as up to 1.3 px in the "
        "picture."
    )
    lens = banner(judged(calibration, weak=(LENS,)))
    assert lens.tone == "doubtful" and lens.explanation.startswith("It does not settle which lens")
    for changes, said in (
        ({"split": HALVES.model_copy(update={"agrees": False})}, "contradict each other"),
        ({"certificate": TWINS.model_copy(update={"holds": False})}, "do not hold"),
    ):
        doubtful = banner(judged(calibration, **changes))
        assert doubtful.tone == "doubtful" and said in doubtful.explanation
        assert not any(check.holds for check in checks_of(judged(calibration, **changes).verdict))
    assert checks_of(None) == () and checks_of(Verdict(usable=True)) == ()


def test_a_baseline_that_is_the_unit_is_held(case: Case) -> None:
    calibration = case[0]
    names = calibration.covariance.names
    matrix = np.array(calibration.covariance.matrix)
    along = np.array(calibration.rig.cam_from_rig[ODD].translation)
    along /= np.linalg.norm(along)
    index = [names.index(f"{ODD}.translation_{axis}") for axis in "xyz"]
    across = np.eye(3) - np.outer(along, along)
    matrix[np.ix_(index, index)] = across * 1e-4
    covariance = calibration.covariance.model_copy(update={"matrix": matrix.tolist()})
    unit = calibration.model_copy(update={"covariance": covariance})
    assert baseline_sigma(unit, ODD) == 0.0
    assert rig_tables(unit)[0].rows[-1].sigma == "held fixed"


def test_large_keypoints_are_not_mismatches(case: Case) -> None:
    """Residuals are judged by the sigma of their own size."""
    _, problem, estimate = case
    seen = problem.observations
    noisy = replace(seen, relative_sigma=np.full(len(seen), 10.0))
    for one, lost in ((problem, True), (replace(problem, observations=noisy), False)):
        part = residuals_by_camera(one, estimate, 0.05)[0]
        assert ((part.norms > part.limits_px).mean() > 0.5) == lost
        assert f"typically {part.sigma_px:.2f} px" in summary(part)


def test_noise_by_what_matching_states(case: Case) -> None:
    """With a line that says where it would be as stated."""
    matched = tuple(one.model_copy(update={"matched": True}) for one in sizes())
    noise = Noise(sigma_px=0.4, by_size={"left": matched})
    panel = noise_panel(case[0].model_copy(update={"noise": noise}))
    assert panel is not None and panel.title == "Noise by what matching states"
    figure = noise_figure({"left": matched})
    line = next(trace for trace in figure.data if trace.name == "as stated")
    ends = (matched[0].smallest_px, matched[-1].largest_px)
    assert tuple(line.x) == tuple(line.y) == ends
    assert figure.layout.xaxis.type == figure.layout.yaxis.type == "log"  # so that it is straight
    assert "stated sigma" in figure.layout.xaxis.title.text
