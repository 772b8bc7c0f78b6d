"""Which of COLMAP's camera models stands for which lens, and what becomes of the parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from graphs.camera import Camera, carries_over, fit_lens, nominal_params
from graphs.lenses import PARAMETER_NAMES, LensName

# One focal length while mapping: with two, OPENCV on a corridor ends at fx 777, fy 208 px. COLMAP's
# EUCM has two and starts from a pinhole, at alpha 0.
MAPPING_MODEL: dict[LensName, str] = {
    "pinhole": "SIMPLE_PINHOLE",
    "simple_radial": "SIMPLE_RADIAL",
    "radial": "RADIAL",
    "radtan": "RADIAL",
    "brown": "RADIAL",
    "rational": "RADIAL",
    "thin_prism": "RADIAL",
    "kannala_brandt": "RADIAL_FISHEYE",
    "division": "SIMPLE_DIVISION",
    "eucm": "RADIAL_FISHEYE",
    "double_sphere": "RADIAL_FISHEYE",
}
# The model that holds every parameter of the lens, to hold our results against COLMAP's; COLMAP
# has none for thin_prism and double_sphere.
EXACT_MODEL: dict[LensName, str] = {
    "pinhole": "PINHOLE",
    "simple_radial": "OPENCV",
    "radial": "OPENCV",
    "radtan": "OPENCV",
    "brown": "FULL_OPENCV",
    "rational": "FULL_OPENCV",
    "kannala_brandt": "OPENCV_FISHEYE",
    "division": "DIVISION",
    "eucm": "EUCM",
}
# The lens whose parameters have the model's names; in what the model lacks it is nominal.
LENS_OF_MODEL: dict[str, LensName] = {
    "SIMPLE_PINHOLE": "pinhole",
    "PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "simple_radial",
    "RADIAL": "radial",
    "OPENCV": "radtan",
    "FULL_OPENCV": "rational",
    "RADIAL_FISHEYE": "kannala_brandt",
    "OPENCV_FISHEYE": "kannala_brandt",
    "SIMPLE_DIVISION": "division",
    "DIVISION": "division",
    "EUCM": "eucm",
}
# Elements out of place, fractions of a per cent: left out without making up for them.
LEFT_OUT = {"p1", "p2", "s1", "s2", "s3", "s4"}
FISHEYE_FOCAL = 0.5  # of the longer side: some 115 degrees across


def fisheye_guess(model: str, name: str, size: tuple[int, int]) -> Camera | None:
    """A fisheye of which nothing is known, where one of COLMAP's models is one.

    COLMAP verifies no pair of a fisheye whose focal length is its own guess.
    """
    if LENS_OF_MODEL[model] != "kannala_brandt":
        return None
    params = nominal_params("kannala_brandt", size, FISHEYE_FOCAL * max(size))
    return Camera(name, "kannala_brandt", size, params)


def in_model(camera: Camera, model: str, names: Collection[str]) -> Camera:
    """The camera with the lens of one of COLMAP's models, whose parameters are called `names`.

    Its parameters by name where that says it all, else the nearest over the image.
    """
    lens = LENS_OF_MODEL[model]
    lost = {n for n, value in camera.named().items() if value and n not in (*names, *LEFT_OUT)}
    if carries_over(camera.lens, lens) and lost <= {"fx", "fy"}:
        return _by_name(camera.name, camera.size, lens, camera.named())
    return fit_lens(camera, lens, free=names)[0]


def out_of_model(
    name: str, size: tuple[int, int], model: str, found: Mapping[str, float], lens: LensName
) -> Camera:
    """The camera of our lens that one of COLMAP's models, with `found` by our names, stands for.

    Parameters that the model has not are nominal. Where names do not mean the same, the nearest
    over the image.
    """
    own = LENS_OF_MODEL[model]
    if carries_over(own, lens):
        return _by_name(name, size, lens, found)
    return fit_lens(_by_name(name, size, own, found), lens)[0]


def _by_name(
    name: str, size: tuple[int, int], lens: LensName, values: Mapping[str, float]
) -> Camera:
    nominal = zip(PARAMETER_NAMES[lens], nominal_params(lens, size, 1.0), strict=True)
    return Camera(name, lens, size, np.array([values.get(p, value) for p, value in nominal]))
