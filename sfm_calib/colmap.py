"""COLMAP through pycolmap: features and mapping. The only module that knows its +0.5.

COLMAP puts (0.5, 0.5) at the centre of the top-left pixel; everything handed out of here has
integer pixel centres.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from graphs.problem import Observations
from graphs.rig_start import FreeModel
from sfm_calib.colmap_lenses import MAPPING_MODEL, fisheye_guess, in_model, out_of_model
from sfm_calib.errors import CalibrationError
from sfm_calib.features import Features
from sfm_calib.images import Progress, Scan
from sfm_calib.mapping_attempts import MappingAttempt

VERSION = pycolmap.__version__
Model = pycolmap.Reconstruction
PIXEL_OFFSET = 0.5
IMAGES_A_BATCH = 10  # progress and Ctrl-C between batches
GLOBAL_ADJUSTMENT_GROWTH = 1.3  # of the model between two global adjustments
LONGEST_SIDE = 3200  # px, COLMAP's own limit: features of larger images are found in reduced ones
DEFAULT_FOCAL = 1.2  # of the longer side, COLMAP's own guess

# COLMAP's names of its parameters, where they are not ours.
PARAMETER_ALIASES = {"k": "k1"}


def quiet(verbose: bool) -> None:
    """COLMAP's own log: all of it, or fatal errors alone."""
    pycolmap.logging.minloglevel = 0 if verbose else 3
    pycolmap.logging.logtostderr = True


def is_verbose() -> bool:
    """Whether COLMAP's own log is shown."""
    return bool(pycolmap.logging.minloglevel == 0)


@contextmanager
def colmap_errors() -> Iterator[None]:
    """COLMAP's exceptions as ours; what aborts it instead is the worker's to tell."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise CalibrationError(f"COLMAP failed: {str(error).splitlines()[-1]}") from error


def colmap_camera(camera: Camera, model: str, camera_id: int = 1) -> pycolmap.Camera:
    """A camera in one of COLMAP's models; the nearest one where the model cannot hold it."""
    width, height = camera.size
    result = pycolmap.Camera.create_from_model_name(camera_id, model, 1.0, width, height)
    names = parameter_names(result)
    near = in_model(camera, model, names)
    ours = near.named() | {"f": float(near.params[:2].mean())}
    ours |= {"cx": ours["cx"] + PIXEL_OFFSET, "cy": ours["cy"] + PIXEL_OFFSET}
    result.params = [ours[name] for name in names]
    return result


def parameter_names(camera: pycolmap.Camera) -> list[str]:
    """Our names of a COLMAP camera's parameters, in its order."""
    names = (name.strip() for name in camera.params_info.split(","))
    return [PARAMETER_ALIASES.get(name, name) for name in names]


def camera_from_colmap(name: str, lens: LensName, camera: pycolmap.Camera) -> Camera:
    """A camera with the parameters that COLMAP found; those its model has not are nominal."""
    found = dict(zip(parameter_names(camera), camera.params.tolist(), strict=True))
    if "f" in found:
        found |= {"fx": found["f"], "fy": found["f"]}
    found |= {"cx": found["cx"] - PIXEL_OFFSET, "cy": found["cy"] - PIXEL_OFFSET}
    return out_of_model(name, (camera.width, camera.height), camera.model.name, found, lens)


def extract_features(
    scan: Scan,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    database: Path,
    max_features: int,
    image_scale: float,
    progress: Progress,
) -> None:
    """SIFT features of every image, found at this share of its size; a COLMAP camera a camera.

    `known`: cameras whose parameters are given; the others start from EXIF or a guess.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = max_features
    # Imported in order first: extraction numbers images as its threads finish them.
    import_images(scan, lenses, known, database)
    done = 0
    for index in range(len(scan.cameras)):
        longest = min(max(scan.sizes[index]), LONGEST_SIDE)
        options.max_image_size = round(image_scale * longest)
        paths = _paths(scan, index)
        reader = _reader(scan, lenses, known, index)
        reader.existing_camera_id = _read_image(database, paths[0]).camera_id
        for begin in range(0, len(paths), IMAGES_A_BATCH):
            batch = paths[begin : begin + IMAGES_A_BATCH]
            with colmap_errors():
                pycolmap.extract_features(
                    database, scan.root, batch, pycolmap.CameraMode.SINGLE, reader, options,
                    pycolmap.Device.cpu,
                )  # fmt: skip
            progress("extracting features", done := done + len(batch), len(scan.images))


def import_images(
    scan: Scan, lenses: Sequence[LensName], known: dict[int, Camera], database: Path
) -> None:
    """A database of the scan's cameras and images without features; `known` as above."""
    with pycolmap.Database.open(database):
        pass  # importing images wants it to exist
    for index in range(len(scan.cameras)):
        reader = _reader(scan, lenses, known, index)
        with colmap_errors():
            pycolmap.import_images(
                database, scan.root, pycolmap.CameraMode.SINGLE, _paths(scan, index), reader
            )


def _paths(scan: Scan, index: int) -> list[str]:
    return [image.path for image in scan.images if image.camera == index]


def _reader(
    scan: Scan, lenses: Sequence[LensName], known: dict[int, Camera], index: int
) -> pycolmap.ImageReaderOptions:
    """How COLMAP reads the images of one camera, and where its lens starts."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = MAPPING_MODEL[lenses[index]]
    reader.default_focal_length_factor = DEFAULT_FOCAL
    guess = fisheye_guess(reader.camera_model, scan.cameras[index], scan.sizes[index])
    start = known.get(index, guess)
    if start is not None:
        reader.camera_params = ",".join(
            map(repr, colmap_camera(start, reader.camera_model).params.tolist())
        )
    return reader


@contextmanager
def keypoint_writer(database: Path) -> Iterator[Callable[[str, FloatArray], None]]:
    """For features found elsewhere: tells a database the pixels (n, 2) of those of one image."""
    with pycolmap.Database.open(database) as db:
        numbers = {image.name: image.image_id for image in db.read_all_images()}
        yield lambda path, pixels: db.write_keypoints(
            numbers[path], (pixels + PIXEL_OFFSET).astype(np.float32)
        )


def write_features(
    scan: Scan,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    features: Sequence[Features],
    database: Path,
) -> None:
    """A database of features found elsewhere, one set an image; cameras as `extract_features`,
    but for EXIF, which is not looked at."""
    with pycolmap.Database.open(database) as db:
        for index, lens in enumerate(lenses):
            model = MAPPING_MODEL[lens]
            guess = fisheye_guess(model, scan.cameras[index], scan.sizes[index])
            start = known.get(index, guess)
            camera = colmap_camera(start or _unseen_camera(scan, lenses, index), model, index + 1)
            camera.has_prior_focal_length = start is not None
            db.write_camera(camera, use_camera_id=True)
        for number, (image, found) in enumerate(zip(scan.images, features, strict=True), 1):
            entry = pycolmap.Image(name=image.path, camera_id=image.camera + 1, image_id=number)
            db.write_image(entry, use_image_id=True)
            db.write_keypoints(number, (found.pixels + PIXEL_OFFSET).astype(np.float32))
            sift = pycolmap.FeatureExtractorType.SIFT
            db.write_descriptors(number, pycolmap.FeatureDescriptors(sift, found.descriptors))


def _read_image(database: Path, path: str) -> pycolmap.Image:
    with pycolmap.Database.open(database) as db:
        image = db.read_image_with_name(path)
    if image is None:
        raise CalibrationError(f"COLMAP could not read {path}: convert it to PNG or JPEG")
    return image


@contextmanager
def open_descriptors(scan: Scan, database: Path) -> Iterator[Callable[[int], NDArray[np.uint8]]]:
    """A reader of the SIFT descriptors (n, 128) of an image by its number, the largest first."""
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}

        def read(number: int) -> NDArray[np.uint8]:
            key = ids[scan.images[number].path]
            largest = np.argsort(-_scales(db, key), kind="stable")
            return np.asarray(db.read_descriptors(key).data)[largest]

        yield read


def constrain_rig(
    scan: Scan, cam_from_rig: Sequence[Transform], reference: int, database: Path
) -> None:
    """Tell a database how its cameras sit, so that mapping places whole frames.

    COLMAP groups images by what follows their camera's folder: `can_constrain` says whether
    that is how this scan's frames are named.
    """
    rig = pycolmap.RigConfig()
    cameras = []
    for index, t in enumerate(cam_from_rig):
        camera = pycolmap.RigConfigCamera()
        first = next(image for image in scan.images if image.camera == index)
        camera.image_prefix = f"{Path(first.path).parent.as_posix()}/"
        camera.ref_sensor = index == reference
        if index != reference:
            camera.cam_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(t.rotation), t.translation)
        cameras.append(camera)
    rig.cameras = sorted(cameras, key=lambda camera: not camera.ref_sensor)  # wanted first
    with pycolmap.Database.open(database) as db:
        pycolmap.apply_rig_config([rig], db)


def can_constrain(scan: Scan) -> bool:
    """Whether images of one frame have the same file name in every camera's folder."""
    names: dict[int, set[str]] = {}
    for image in scan.images:
        names.setdefault(image.frame, set()).add(Path(image.path).name)
    return len(scan.cameras) > 1 and all(len(of_frame) == 1 for of_frame in names.values())


def worth(models: Sequence[pycolmap.Reconstruction], scan: Scan) -> tuple[int, int, int]:
    """What a mapping explains: cameras placed in any model, images and observations of the largest.

    Cameras first: models of different cameras can be joined through the rig's motion.
    """
    if not models:
        return 0, 0, 0
    owner = {image.path: image.camera for image in scan.images}
    names = {m.images[i].name for m in models for i in m.reg_image_ids()}
    cameras = {owner[name] for name in names}
    return len(cameras), models[0].num_reg_images(), models[0].compute_num_observations()


def write_models(models: Sequence[pycolmap.Reconstruction], place: Path) -> None:
    """Keep these models alone in `place`, the largest as 0.

    Raises OSError when the disk is full, of which COLMAP says nothing.
    """
    shutil.rmtree(place, ignore_errors=True)
    for number, model in enumerate(models):
        folder = place / str(number)
        folder.mkdir(parents=True)
        model.write(folder)
        if not _is_whole(model, folder):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _is_whole(model: pycolmap.Reconstruction, folder: Path) -> bool:
    try:
        kept = pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, RuntimeError, MemoryError):
        return False
    counts = [(m.num_points3D(), m.num_reg_images()) for m in (kept, model)]
    return bool(counts[0] == counts[1])


def read_models(place: Path) -> list[pycolmap.Reconstruction]:
    """The models that `write_models` kept, in its order."""
    folders = sorted((place / "best").iterdir(), key=lambda folder: int(folder.name))
    return [pycolmap.Reconstruction(folder) for folder in folders]


def map_images(
    scan: Scan, database: Path, out: Path, attempt: MappingAttempt, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """Incremental mapping: models, the one with most images first.

    Images are placed freely, unless `constrain_rig` was told of the database.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.random_seed = attempt.seed
    options.num_threads = 1  # with two, sums are ordered by chance and results differ by 1e-11
    options.mapper.random_seed = attempt.seed
    options.triangulation.random_seed = attempt.seed
    # The graph has the last word: mapping may end less polished, in two thirds of the time.
    options.ba_global_frames_ratio = GLOBAL_ADJUSTMENT_GROWTH
    options.ba_global_points_ratio = GLOBAL_ADJUSTMENT_GROWTH
    options.ba_global_max_refinements = 2
    options.mapper.init_min_tri_angle = attempt.min_start_angle_deg
    options.mapper.init_max_forward_motion = attempt.max_start_forward
    pycolmap.set_random_seed(attempt.seed)
    out.mkdir(parents=True, exist_ok=True)
    registered = 0

    def count() -> None:
        nonlocal registered
        registered = min(registered + 1, len(scan.images))
        progress("mapping", registered, len(scan.images))

    with colmap_errors():
        models = pycolmap.incremental_mapping(
            database, scan.root, out, options,
            initial_image_pair_callback=count, next_image_callback=count,
        )  # fmt: skip
    return sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def keypoint_scales(database: Path) -> dict[str, FloatArray]:
    """Sizes (n,) in px of the keypoints of each image, by path: how far their frames reach.

    NaN, for unknown, of those that have no frame.
    """
    with pycolmap.Database.open(database) as db:
        return {image.name: _scales(db, image.image_id) for image in db.read_all_images()}


def _scales(db: pycolmap.Database, image_id: int) -> FloatArray:
    keypoints = np.asarray(db.read_keypoints(image_id), dtype=np.float64)
    if keypoints.shape[1] < 6:
        return np.full(len(keypoints), np.nan)
    result: FloatArray = np.abs(np.linalg.det(keypoints[:, 2:6].reshape(-1, 2, 2))) ** 0.5
    return result


def free_model(
    reconstruction: pycolmap.Reconstruction,
    scan: Scan,
    lenses: Sequence[LensName],
    scales: dict[str, FloatArray],
) -> FreeModel:
    """A reconstruction as arrays: poses by (camera, frame), points, observations.

    scales: as `keypoint_scales`.
    """
    place = {image.path: image for image in scan.images}
    images = {i: reconstruction.images[i] for i in sorted(reconstruction.reg_image_ids())}
    cameras: dict[int, Camera] = {}
    poses = {}
    for image in images.values():
        here, found = place[image.name], image.camera
        assert found is not None  # a registered image has one
        pose = image.cam_from_world()
        poses[here.camera, here.frame] = Transform(
            pose.rotation.matrix(), np.ravel(pose.translation)
        )
        if here.camera not in cameras:
            name, lens = scan.cameras[here.camera], lenses[here.camera]
            cameras[here.camera] = camera_from_colmap(name, lens, found)
    keypoints = {i: np.array([p.xy for p in image.points2D]) for i, image in images.items()}
    pixels, frames, owners, points, positions, sizes = [], [], [], [], [], []
    for number, point_id in enumerate(sorted(reconstruction.points3D)):
        point = reconstruction.points3D[point_id]
        positions.append(np.ravel(point.xyz))
        elements = sorted((e.image_id, e.point2D_idx) for e in point.track.elements)
        for image_id, keypoint in elements:
            here = place[images[image_id].name]
            pixels.append(keypoints[image_id][keypoint] - PIXEL_OFFSET)
            frames.append(here.frame)
            owners.append(here.camera)
            points.append(number)
            sizes.append(scales[images[image_id].name][keypoint])
    observations = Observations(
        np.array(pixels), np.array(frames), np.array(owners), np.array(points),
        feature_scale=np.array(sizes),
    )  # fmt: skip
    every = tuple(
        cameras.get(i) or _unseen_camera(scan, lenses, i) for i in range(len(scan.cameras))
    )
    return FreeModel(every, poses, np.array(positions), observations)


def _unseen_camera(scan: Scan, lenses: Sequence[LensName], index: int) -> Camera:
    width, height = scan.sizes[index]
    guess = pycolmap.Camera.create_from_model_name(
        1, MAPPING_MODEL[lenses[index]], DEFAULT_FOCAL * max(width, height), width, height
    )
    return camera_from_colmap(scan.cameras[index], lenses[index], guess)
