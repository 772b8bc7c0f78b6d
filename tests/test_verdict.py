"""What is said of a result before it is used: by hand-made runs, a doubt at a time."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic.directions import rig
from test_findings import solved

from graphs.jackknife import Jackknife
from graphs.ladder import Rung
from graphs.observability import Observability
from graphs.observability import WeakDirection as Direction
from graphs.priors import stated_lens_prior, weak_lens_prior
from graphs.problem import KnownBaseline, Observations, Problem
from graphs.split_check import SplitCheck
from graphs.twin import Certificate
from sfm_calib import result, verdict
from sfm_calib.config import CameraConfig, RigConfig
from sfm_calib.findings import solve_findings
from sfm_calib.run import Run

NAMES = ("cam0.fx", "cam0.cx")
AGREE = SplitCheck(difference_px=0.8, expected_px=1.0, model_px=0.5, p_value=0.6)
APART = SplitCheck(difference_px=4.0, expected_px=1.0, model_px=0.5, p_value=0.004)
STATED = {"fx": 2.0, "cx": 5.0}  # sigmas in rig.yaml
OPEN = Direction(
    kind="principal point",
    what="cx: the principal point against tilt",
    parameters=("cam0.cx",),
    moves=(3.0,),
    moves_px=(3.0,),
    slide_px=3.0,
    data_slide_px=np.inf,
    effect_centre_px=0.1,
    effect_corner_px=0.7,
    prior_share=1.0,
    remedy="turn the rig about its optical axis",
)


def twins(mean: float, spread: float = 0.1, trials: int = 16) -> Certificate:
    """Of such a mean NEES, which has a standard error of spread / sqrt(trials - 1)."""
    nees = mean + spread * np.tile([-1.0, 1.0], trials // 2)
    z = np.zeros((trials, 2))
    z[:4, 1] = 3.0  # outside of the 95 % interval
    return Certificate(NAMES, z, nees, 2 * nees, 1)


def jackknife(*failed: tuple[str, str]) -> Jackknife:
    kept = tuple((str(2 * i), str(2 * i + 1)) for i in range(10 - len(failed)))
    return Jackknife(NAMES, np.zeros((len(kept), 2)), np.eye(2), kept, failed)


def problem_of(frames: int, kept: int, *scales: KnownBaseline) -> Problem:
    """One camera that observes points in one frame after the other, some of them in the last."""
    frame = np.arange(kept) % frames
    seen = Observations(np.zeros((kept, 2)), frame, np.zeros_like(frame), np.zeros_like(frame))
    return Problem(rig(1), seen, tuple(f"{i:06d}" for i in range(frames)), 0, scales)


def run(
    *,
    frames: int = 20,
    kept: int = 900,
    rejected: int = 100,
    converged: bool = True,
    off: dict[str, float] | None = None,
    stated: dict[str, float] = STATED,
    scale: KnownBaseline | None = None,
    matched_px: float | None = None,
    **own: object,
) -> Run:
    """A run without anything to say of it; off: prior sigmas by which parameters come out off."""
    problem = problem_of(frames, kept, *([scale] if scale else []))
    if matched_px is not None:
        stated_px = np.full(kept, matched_px)
        seen = replace(problem.observations, matched_sigma_px=stated_px)
        problem = replace(problem, observations=seen)
    (camera,) = problem.initial.cameras
    prior = stated_lens_prior(camera, weak_lens_prior(camera), camera.named(), stated, ("cy",))
    moves = np.array([(off or {}).get(name, 0.0) for name in camera.names]) * prior.sigma
    cameras = (replace(camera, params=camera.params + moves),)
    refinement = SimpleNamespace(
        problem=problem,
        estimate=replace(problem.initial, cameras=cameras),
        graph=SimpleNamespace(lens_priors=(prior,)),
        n_rejected=rejected,
        sigma_px=0.12,
        summary=SimpleNamespace(converged=converged, reason="steps ran out"),
    )
    parts = {
        "scan": SimpleNamespace(warnings=("scan: odd",), cameras=("cam0",)),
        "config": RigConfig(cameras={"cam0": CameraConfig(sigma=stated)}),
        "mapped": mapped(problem),
        "refinement": refinement,
        "covariance": with_blocks(jackknife()),
        "split": AGREE,
        "seconds": {},
        "command": "",
    }
    return Run(**parts | own)


def mapped(problem: Problem) -> SimpleNamespace:
    return SimpleNamespace(problem=problem, messages=("map: odd",))


def climbed(n_frames: int) -> SimpleNamespace:
    """A ladder of one rung."""
    return SimpleNamespace(
        best=SimpleNamespace(rung=Rung("radial")), rungs=(None,), chosen=0, n_frames=n_frames
    )


def with_blocks(found: Jackknife | None) -> SimpleNamespace:
    return SimpleNamespace(
        stated=None, model=None, basis=SimpleNamespace(unit=1.0), jackknife=found
    )


def judged(
    monkeypatch: pytest.MonkeyPatch, of: Run, seen: Observability | None = None
) -> result.Verdict:
    """The verdict, where observability is given."""
    nothing = Observability(weak=(), unusable=(), lacks=(), prior_shares={})
    monkeypatch.setattr(verdict, "observe", lambda *_: nothing if seen is None else seen)
    return verdict.verdict_of(of)


# ---- the certificate -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "spread", "holds"),
    [
        (0.5, 0.1, False),  # sigmas that are too large mislead too
        (0.7, 0.1, False),
        (0.9, 0.1, True),
        (1.0, 0.1, True),
        (1.25, 0.1, True),
        (1.5, 0.1, False),
        (2.0, 0.1, False),
        (0.5, 1.0, True),  # so few twins that scatter so much do not tell
        (1.7, 1.0, True),
    ],
)
def test_a_certificate_holds_where_errors_are_neither_larger_nor_smaller_than_sigmas(
    mean: float, spread: float, holds: bool
) -> None:
    assert verdict.certificate_of(twins(mean, spread)).holds == holds


def test_a_certificate_says_what_the_twins_showed() -> None:
    found = verdict.certificate_of(twins(1.0))
    assert (found.trials, found.failed) == (16, 1)
    assert found.nees == pytest.approx(1) and found.model_nees == pytest.approx(2)
    assert found.nees_standard_error == pytest.approx(0.1 / 15**0.5)
    assert found.coverage == pytest.approx((1 + 12 / 16) / 2)
    assert (found.least_covered, found.least_coverage) == ("cam0.cx", 12 / 16)


# ---- what is doubtful ----------------------------------------------------------------------


def test_of_an_ordinary_run_nothing_is_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    assert verdict._doubts(run()) == []
    assert verdict._doubts(run(split=None, covariance=with_blocks(None))) == []
    said = judged(monkeypatch, run(certificate=twins(1.0)))
    assert said.usable and said.weak == ()
    assert said.messages == ("scan: odd", "map: odd")
    assert said.split is not None and said.split.agrees
    assert said.certificate is not None and said.certificate.holds
    assert judged(monkeypatch, run(split=None)).split is None


Doubt = tuple[dict[str, object], tuple[str, ...]]
LOST = with_blocks(jackknife(("000004", "000007"), ("000012", "000015")))
DOUBTS: list[Doubt] = [
    ({"frames": 10}, ()),
    ({"frames": 9}, ("only 9 frames: ",)),
    ({"kept": 760, "rejected": 240}, ()),
    ({"kept": 700, "rejected": 300}, ("30% of the observations were set aside",)),
    ({"split": APART}, ("two halves of the frames, calibrated alone, project 4.00 px apart",)),
    (
        {"covariance": LOST},
        (
            "without the frames 000004 to 000007 the scan determines nothing",
            "without the frames 000012 to 000015 the scan determines nothing",
        ),
    ),
    ({"matched_px": 0.1}, ()),
    ({"matched_px": 0.08}, ("matched patches scatter 1.5 times as much as matching says",)),
    ({"ladder": climbed(2)}, ()),
    ({"ladder": climbed(1)}, ("the lens radial is a guess: no frame could be held out",)),
    (
        {"mapped": mapped(problem_of(22, 900))},
        (
            "2 images see too few points that are consistent between views, and were left out: "
            "cam0/000020, cam0/000021",
        ),
    ),
    ({"scale": KnownBaseline((0, 1), 2.0, 0.19)}, ()),
    ({"scale": KnownBaseline((0, 1), 2.0, 0.4)}, ("the measured distance is known to 20% only",)),
    ({"off": {"fx": 3.9, "cx": -3.9, "k1": 50.0, "cy": 50.0}}, ()),  # k1 not stated, cy held
    (
        {"off": {"cx": -6.0, "fx": 9.0}, "stated": {}},
        ("cam0.cx came out 6 sigmas of principal_point_sigma from",),
    ),
    (
        {"off": {"fx": 6.0, "cx": -5.0}},
        ("cam0.fx came out 6 of its stated sigmas", "cam0.cx came out 5 of its stated sigmas"),
    ),
]


@pytest.mark.parametrize(("changes", "words"), DOUBTS)
def test_each_doubt_is_told(
    changes: dict[str, object], words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    doubtful = run(**changes)
    own = verdict._doubts(doubtful) + verdict._contradictions(doubtful)
    assert len(own) == len(words)
    assert all(told.startswith(start) for told, start in zip(own, words, strict=True))
    said = judged(monkeypatch, doubtful)
    assert said.messages == ("scan: odd", "map: odd", *own)
    assert said.usable  # doubts are to be read; numbers stand


def test_a_contradiction_names_what_was_stated() -> None:
    (told,) = verdict._contradictions(run(off={"cx": 10.0}))
    mean = rig(1).cameras[0].named()["cx"]
    assert told.endswith(f"10 of its stated sigmas from {mean:g}: the scan contradicts rig.yaml")


def test_a_lens_that_may_be_another_is_weak(monkeypatch: pytest.MonkeyPatch) -> None:
    doubt = SimpleNamespace(
        label="brown", verdict="chance", gain_px=0.003, gain_sigmas=0.7, corner_px=4.7,
        parameters=("cam0.k1", "cam0.cx"), moves=(0.02, 1.5), moves_sigmas=(-2.6, 1.2),
    )  # fmt: skip
    monkeypatch.setattr(verdict, "lens_doubt", lambda *_: doubt)
    (weak,) = judged(monkeypatch, run(ladder=climbed(9))).weak
    assert weak.kind == "choice of the lens" and weak.effect_px == 4.7
    assert (weak.parameters, weak.moves) == (doubt.parameters, doubt.moves)
    assert "brown" in weak.what and "radial" in weak.what and "2.6 stated sigmas" in weak.what
    assert judged(monkeypatch, run()).weak == ()  # a lens that was given


def test_sigmas_that_twins_refute_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    said = judged(monkeypatch, run(certificate=twins(4.0)))
    assert said.certificate is not None and not said.certificate.holds
    assert said.messages[-1].startswith("simulated twins of this scan err by 2.0 of their stated")
    assert "95 % intervals hold 88% of the truths" in said.messages[-1]


# ---- what is not to be used ----------------------------------------------------------------


def test_what_is_too_uncertain_is_not_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Observability((OPEN,), ("rays of cam0 are off",), ("parallel views: all",), {})
    said = judged(monkeypatch, run(), seen)
    assert not said.usable
    assert said.messages[0] == "not usable: rays of cam0 are off"
    assert said.messages[-1] == "parallel views: all"
    (weak,) = said.weak
    assert weak.effect_px == 0.7 and weak.data_slide_px is None
    for name in ("what", "remedy", "kind", "parameters", "moves", "slide_px", "prior_share"):
        assert getattr(weak, name) == getattr(OPEN, name)
    said = judged(monkeypatch, run(converged=False), seen)
    assert said.messages[0] == "not usable: the solve did not converge: steps ran out"
    assert not judged(monkeypatch, run(converged=False)).usable


# ---- as findings of a check ----------------------------------------------------------------


def test_rays_that_cannot_be_used_and_weak_directions_are_findings() -> None:
    said = result.Verdict(
        usable=False,
        weak=(verdict._weak(OPEN),),
        messages=("not usable: rays of cam0 are off", "not usable: fx is", "rays of light"),
    )
    rays, weak = solve_findings(solved().model_copy(update={"verdict": said}))
    assert (rays.severity, rays.topic, rays.what) == ("cannot", "rays", "rays of cam0 are off")
    assert (weak.severity, weak.topic, weak.value) == ("doubtful", "weak", 3.0)
    assert weak.what.startswith(f"{OPEN.what}: free by 3 px, which shows as 0.1 px")
    assert weak.remedy == OPEN.remedy and rays.remedy


def test_without_a_verdict_or_with_a_good_one_there_is_nothing_to_find() -> None:
    assert solve_findings(solved()) == []
    good = result.Verdict(usable=True, messages=("only 9 frames: few",))
    assert solve_findings(solved().model_copy(update={"verdict": good})) == []
