from pathlib import Path

import pytest
from pydantic import BaseModel

from sfm_calib.config import (
    BaselineConfig,
    CameraConfig,
    CamFromRigConfig,
    Options,
    RigConfig,
    ScaleConfig,
    load_rig_config,
)
from sfm_calib.images import Scan
from sfm_calib.nominal import check_config

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "configs/rigs/example_rig.yaml"


@pytest.fixture(scope="module")
def example() -> RigConfig:
    return load_rig_config(EXAMPLE)


def test_example_fits_the_simulated_rig(example: RigConfig) -> None:
    names = ("cam0", "cam1", "cam2")
    check_config(example, Scan(ROOT, names, ((640, 480),) * 3, (), ()))


def test_example_shows_every_key(example: RigConfig) -> None:
    shown = set(example.model_fields_set)
    for camera in example.cameras.values():
        shown |= camera.model_fields_set
        if camera.cam_from_rig:
            shown |= camera.cam_from_rig.model_fields_set
    shown |= example.scale.model_fields_set
    assert example.scale.baseline is not None
    shown |= example.scale.baseline.model_fields_set
    models: list[type[BaseModel]] = [RigConfig, CameraConfig, CamFromRigConfig]
    models += [ScaleConfig, BaselineConfig]
    assert shown == {name for model in models for name in model.model_fields}


def test_example_states_the_defaults(example: RigConfig) -> None:
    assert example.options() == Options(reference="cam0")


@pytest.mark.parametrize("name", Options.model_fields)
def test_readme_documents_every_option(name: str) -> None:
    assert f"`{name}`" in (ROOT / "README.md").read_text()
