import re
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

from sfm_calib.config import (
    BaselineConfig,
    CameraConfig,
    CamFromRigConfig,
    ClickConfig,
    FramesConfig,
    Options,
    PointsConfig,
    RigConfig,
    ScaleConfig,
    load_rig_config,
)
from sfm_calib.images import Scan, ScanImage
from sfm_calib.nominal import check_config
from sfm_calib.scale import check_scale

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "configs/rigs/example_rig.yaml"


@pytest.fixture(scope="module")
def example() -> RigConfig:
    return load_rig_config(EXAMPLE)


def test_example_fits_the_simulated_rig(example: RigConfig) -> None:
    names = ("cam0", "cam1", "cam2")
    check_config(example, Scan(ROOT, names, ((640, 480),) * 3, (), ()))


def shown_scales() -> list[ScaleConfig]:
    """The sources of scale that the example shows, all but the first in comments."""
    text = EXAMPLE.read_text()
    lines = text[text.index("\nscale:") :].splitlines()
    inside = [re.sub("^  # ", "  ", line) for line in lines if line.startswith("  ")]
    sources = yaml.safe_load("\n".join(inside))
    return [ScaleConfig.model_validate({name: said}) for name, said in sources.items()]


def test_example_shows_every_source_of_scale_and_each_could_be() -> None:
    shown = [scale.model_fields_set for scale in shown_scales()]
    assert shown == [{name} for name in ScaleConfig.model_fields]
    names = ("cam0", "cam1", "cam2")
    frames = tuple(f"{i:06d}" for i in range(40))
    images = tuple(
        ScanImage(c, f, f"{name}/{frame}.png")
        for c, name in enumerate(names)
        for f, frame in enumerate(frames)
    )
    for scale in shown_scales():
        check_scale(scale, Scan(ROOT, names, ((640, 480),) * 3, frames, images))


def test_example_shows_every_key(example: RigConfig) -> None:
    shown = set(example.model_fields_set)
    for camera in example.cameras.values():
        shown |= camera.model_fields_set
        if camera.cam_from_rig:
            shown |= camera.cam_from_rig.model_fields_set
    for scale in shown_scales():
        shown |= scale.model_fields_set
        ((_, measured),) = scale.measured
        shown |= measured.model_fields_set
        if isinstance(measured, PointsConfig):
            shown |= measured.between[0][0].model_fields_set
    models: list[type[BaseModel]] = [RigConfig, CameraConfig, CamFromRigConfig, ScaleConfig]
    models += [BaselineConfig, FramesConfig, PointsConfig, ClickConfig]
    assert shown == {name for model in models for name in model.model_fields}


def test_example_states_the_defaults(example: RigConfig) -> None:
    assert example.options() == Options(reference="cam0")


@pytest.mark.parametrize("name", Options.model_fields)
def test_readme_documents_every_option(name: str) -> None:
    assert f"`{name}`" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("name", ScaleConfig.model_fields)
def test_readme_documents_every_source_of_scale(name: str) -> None:
    assert f"`scale.{name}`" in (ROOT / "README.md").read_text()
