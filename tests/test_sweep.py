"""A study's config file: what it asks for, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from experiments.runner import sweep
from experiments.runner.registry import about, studies, study_of
from experiments.runner.sweep import load_study, trials_of
from sfm_calib.errors import CalibrationError

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "configs/studies").glob("*.yaml"))


def config(folder: Path, text: str) -> Path:
    path = folder / "study.yaml"
    path.write_text(text)
    return path


def test_grid_times_list_times_seeds(tmp_path: Path) -> None:
    path = config(
        tmp_path,
        "study: example\noptions: {pause_s: 0.5}\ngrid: {draws: [2, 3, 4]}\n"
        "list: [{sigma: 1}, {sigma: 2}]\nseeds: [7, 9]\n",
    )
    trials = trials_of(load_study(path))
    asked = [(t.seed, t.options.sigma, t.options.draws) for t in trials]  # type: ignore[attr-defined]
    assert asked == [(s, sigma, d) for s in (7, 9) for sigma in (1, 2) for d in (2, 3, 4)]
    assert {t.options.pause_s for t in trials} == {0.5}  # type: ignore[attr-defined]
    assert len({t.key for t in trials}) == len(trials)


def test_seeds_may_be_a_number(tmp_path: Path) -> None:
    trials = trials_of(load_study(config(tmp_path, "study: example\nseeds: 3\n")))
    assert [t.seed for t in trials] == [0, 1, 2]


def test_keys_do_not_depend_on_how_it_is_written(tmp_path: Path) -> None:
    one = trials_of(load_study(config(tmp_path, "study: example\noptions: {draws: 5}\n")))
    two = trials_of(load_study(config(tmp_path, "seeds: [0]\ngrid: {draws: [5]}\nstudy: example")))
    assert one[0].key == two[0].key


def test_settings_take_the_place_of_what_is_swept(tmp_path: Path) -> None:
    path = config(tmp_path, "study: example\ngrid: {draws: [2, 3], sigma: [1, 2]}\nseeds: 4\n")
    settings = ["seeds=1", "options.draws=9", "grid.sigma=[3, 4]"]
    trials = trials_of(load_study(path, settings))
    assert [(t.options.draws, t.options.sigma) for t in trials] == [(9, 3), (9, 4)]  # type: ignore[attr-defined]


def test_a_setting_joins_what_was_listed_apart(tmp_path: Path) -> None:
    path = config(tmp_path, "study: example\nlist: [{draws: 2}, {draws: 3}, {draws: 3, sigma: 2}]")
    trials = trials_of(load_study(path, ["options.draws=9"]))
    assert [(t.options.draws, t.options.sigma) for t in trials] == [(9, 1), (9, 2)]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("study: exmple", "there is no study 'exmple'; did you mean 'example'?"),
        ("seeds: 3", "names no study: begin with 'study: NAME'"),
        ("study: example\nseeds: 1\nseeds: 2", "in line 3: the key 'seeds' stands twice"),
        ("study: example\nseeds: 1000000000000", "seeds: Input should be"),
        ("study: example\nseed: 3", "unknown key 'seed': did you mean 'seeds'?"),
        ("study: example\nseeds: 0", "seeds"),
        ("study: example\nthreads: 0", "threads"),
        ("study: example\nseeds: [-1]", "seeds"),
        ("study: example\noptions: {drws: 3}", "has no option 'drws': did you mean 'draws'?"),
        ("study: example\ngrid: {sigm: [3]}", "grid: example has no option 'sigm'"),
        ("study: example\nlist: [{sgma: 3}]", "list: example has no option 'sgma'"),
        ("study: example\ngrid: {draws: []}", "grid.draws"),
        ("study: example\ngrid: {draws: 3}", "grid.draws: takes a list, like [a, b] (got 3)"),
        ("study: example\noptions: {draws: 3}\ngrid: {draws: [4]}", "in options and in grid"),
        ("study: example\noptions: {draws: 0}", "draws: Input should be greater than or equal"),
        ("study: example\ngrid: {draws: [2, -1]}", '(trial {"draws": -1})'),
        ("study: example\ngrid: {draws: [2, 2]}", "two trials are the same"),
        ("study: example\noptions: {sigma: .nan}", "sigma"),
        ("study: example\nseeds: [1, 1]", "two trials are the same"),
        ("- study", "holds no keys"),
        ("study: [", "not valid YAML"),
        ("study: example\nseeds: 900000\ngrid: {draws: [2, 3]}", "more than 1,000,000 trials"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(CalibrationError) as error:
        trials_of(load_study(config(tmp_path, text)))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seeds", "write key=value"),
        ("=3", "write key=value"),
        ("options.=3", "write key=value"),
        ("option.draws=3", "did you mean 'options'?"),
        ("options.drws=3", "did you mean 'draws'?"),
        ("seeds=[", "not valid YAML"),
        ("seeds=many", "seeds"),
    ],
)
def test_settings_that_are_wrong(tmp_path: Path, setting: str, said: str) -> None:
    with pytest.raises(CalibrationError) as error:
        load_study(config(tmp_path, "study: example"), [setting])
    assert said in str(error.value)


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(CalibrationError, match="is not there"):
        load_study(Path("nowhere.yaml"))


def test_content_decides_what_a_folder_is(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    (folder / "left").mkdir(parents=True)
    (folder / "left" / "a.txt").write_text("1")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/b.txt").write_text("1")
    (folder / "right").symlink_to(tmp_path / "elsewhere")
    (folder / "left" / "round").symlink_to(folder)
    before = sweep.content_digest(folder)
    (tmp_path / "elsewhere/b.txt").write_text("2")
    assert sweep.content_digest(folder) != before
    (tmp_path / "elsewhere/b.txt").write_text("1")
    (folder / "left" / "a.txt").write_text("1")
    assert sweep.content_digest(folder) == before
    (folder / "left" / "a.txt").write_text("2")
    changed = sweep.content_digest(folder)
    (folder / "left" / "a.txt").rename(folder / "left" / "b.txt")
    assert len({before, changed, sweep.content_digest(folder)}) == 3


@pytest.mark.parametrize("name", studies())
def test_every_study_says_what_it_asks(name: str) -> None:
    """Its first line is a question, and it says what it expects and how it is run."""
    text = about(name)
    assert text.splitlines()[0].endswith("?")
    for part in (
        "Method:",
        "Expectation:",
        "Source:",
        f"sfm-calib run configs/studies/{name}.yaml",
    ):
        assert part in text, part
    assert study_of(name).options.model_config["extra"] == "forbid"


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_that_ships_can_be_run(path: Path) -> None:
    trials = trials_of(load_study(path))
    assert trials
    assert yaml.safe_load(path.read_text()).get("seconds"), "what a trial takes is said"


def test_every_study_has_a_config() -> None:
    assert {path.stem for path in CONFIGS} >= set(studies()) - {"calibrations"}
