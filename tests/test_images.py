"""The scan's layout: what is found, what is passed by, and what is refused in one line."""

import os
import shutil
import struct

import cv2
import numpy as np
import pytest
from synthetic.scans import picture, silent

from sfm_calib import images
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.images import IMAGE_SUFFIXES, camera_names, counting_order, image_size, read_scan


def read(scan, matching="stem"):
    return read_scan(scan, Cache(scan.parent / "cache"), matching, 10, silent)


def refusal(scan, matching="stem"):
    with pytest.raises(CalibrationError) as caught:
        read(scan, matching)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def rig(scan, cameras=("left", "right"), n=3):
    for camera in cameras:
        for number in range(n):
            picture(scan / camera / f"{number}.png")
    return scan


def test_a_flat_folder_is_one_camera(tmp_path):
    for number in range(3):
        picture(tmp_path / "scan" / f"{number}.png")
    scan = read(tmp_path / "scan")
    assert scan.cameras == ("camera",) and scan.sizes == ((32, 24),)
    assert [image.path for image in scan.images] == ["0.png", "1.png", "2.png"]
    assert camera_names(tmp_path / "scan") == scan.cameras


def test_folders_are_cameras_and_stems_are_frames(tmp_path):
    scan = rig(tmp_path / "scan")
    picture(scan / "right" / "3.JPG")
    picture(scan / ".hidden" / "0.png")
    picture(scan / "left" / ".0.png")
    (scan / "notes").mkdir()
    found = read(scan)
    assert found.cameras == ("left", "right") and found.frames == ("0", "1", "2", "3")
    assert [(i.camera, i.frame) for i in found.images] == [
        *[(0, 0), (0, 1), (0, 2)],
        *[(1, 0), (1, 1), (1, 2), (1, 3)],
    ]
    assert found.name(found.images[-1]) == "right/3"
    assert camera_names(scan) == found.cameras


def test_frames_are_in_counting_order(tmp_path):
    for number in (0, 2, 10, 1):
        picture(tmp_path / "scan" / f"im{number}.png")
    assert read(tmp_path / "scan").frames == ("im0", "im1", "im2", "im10")
    assert sorted(["b", "a10b2", "a9", "10", "a10b1", "²"], key=counting_order) == [
        *("10", "a9", "a10b1", "a10b2", "b", "²")
    ]


def test_symbolic_links_to_folders_are_followed(tmp_path):
    rig(tmp_path / "elsewhere")
    (tmp_path / "scan").mkdir()
    for name in ("left", "right"):
        (tmp_path / "scan" / name).symlink_to(tmp_path / "elsewhere" / name)
    assert read(tmp_path / "scan").cameras == ("left", "right")


def test_names_may_hold_blanks_and_umlauts(tmp_path):
    scan = rig(tmp_path / "mein scän", ("vordere Käm", "hintere Käm"))
    assert read(scan).images[0].path == "hintere Käm/0.png"


def test_matching_by_order(tmp_path):
    for number in range(3):
        picture(tmp_path / "scan" / "left" / f"l{number}.png")
        picture(tmp_path / "scan" / "right" / f"r{number}.png")
    found = read(tmp_path / "scan", "order")
    assert [image.frame for image in found.images] == [0, 1, 2, 0, 1, 2] and not found.warnings


def test_an_unreadable_image_keeps_its_place_in_the_order(tmp_path):
    scan = rig(tmp_path / "scan", n=4)
    (scan / "left" / "1.png").write_bytes(b"")
    found = read(scan, "order")
    assert [i.frame for i in found.images if i.camera == 0] == [0, 2, 3]
    assert [i.frame for i in found.images if i.camera == 1] == [0, 1, 2, 3]


def test_matching_by_order_doubts_different_numbers_of_images(tmp_path):
    scan = rig(tmp_path / "scan")
    picture(scan / "left" / "9.png")
    assert "left 4, right 3" in read(scan, "order").warnings[0]


def test_no_such_folder(tmp_path):
    assert "no such scan" in refusal(tmp_path / "nowhere")


def test_a_folder_without_images_says_what_it_has_instead(tmp_path):
    (tmp_path / "scan").mkdir()
    assert "holds no images" in refusal(tmp_path / "scan")
    (tmp_path / "scan" / "a.webp").write_bytes(b"")
    (tmp_path / "scan" / "a.cr2").write_bytes(b"")
    message = refusal(tmp_path / "scan")
    assert "it has .cr2 .webp files" in message and ".png" in message and ".mp4" in message


def test_a_file_that_is_no_video(tmp_path):
    path = picture(tmp_path / "one.png")
    assert "is no video" in refusal(path)


def test_unreadable_images_are_named_and_skipped(tmp_path):
    scan = rig(tmp_path / "scan", n=4)
    (scan / "left" / "1.png").write_bytes(b"no image")
    os.unlink(scan / "right" / "2.png")
    (scan / "right" / "2.png").symlink_to(tmp_path / "nowhere")
    found = read(scan)
    assert [w.split(" is ")[0] for w in found.warnings] == ["left/1.png", "right/2.png"]
    assert all("skipped" in warning for warning in found.warnings) and len(found.images) == 6


def test_too_few_images_names_the_unreadable_ones(tmp_path):
    picture(tmp_path / "scan" / "0.png")
    assert "holds 1 readable image," in refusal(tmp_path / "scan")
    for name in ("1.png", "2.png"):
        (tmp_path / "scan" / name).write_bytes(b"")
    message = refusal(tmp_path / "scan")
    assert "1.png is unreadable" in message and "needs at least 3" in message


def test_nothing_readable(tmp_path):
    scan = rig(tmp_path / "scan")
    for path in (scan / "right").iterdir():
        path.write_bytes(b"")
    assert "camera right: none of its images" in refusal(scan)
    shutil.rmtree(scan / "left")
    assert "none of the 3 images" in refusal(scan)


def test_sizes_that_differ_within_a_camera(tmp_path):
    scan = rig(tmp_path / "scan")
    picture(scan / "right" / "7.png", size=(24, 32))
    message = refusal(scan)
    assert "camera right: 7.png is 24x32 and 0.png is 32x24" in message


def test_sizes_may_differ_between_cameras(tmp_path):
    scan = rig(tmp_path / "scan", ("left",))
    for number in range(3):
        picture(scan / "right" / f"{number}.png", size=(64, 48))
    assert read(scan).sizes == ((32, 24), (64, 48))


def test_two_images_of_one_stem(tmp_path):
    scan = rig(tmp_path / "scan")
    picture(scan / "left" / "1.jpg")
    assert "camera left has 2 images called 1" in refusal(scan)


def test_images_beside_folders_of_images(tmp_path):
    scan = rig(tmp_path / "scan")
    picture(scan / "stray.png")
    assert "1 images beside 2 folders" in refusal(scan)


def test_cameras_that_share_no_stem(tmp_path):
    for number in range(3):
        picture(tmp_path / "scan" / "left" / f"l{number}.png")
        picture(tmp_path / "scan" / "right" / f"r{number}.png")
    message = refusal(tmp_path / "scan")
    assert "camera left" in message and "'l0'" in message and "--frames order" in message


def test_names_that_are_not_text(tmp_path):
    scan = rig(tmp_path / "scan")
    os.rename(os.fsencode(scan / "left" / "0.png"), os.fsencode(scan / "left") + b"/\xff.png")
    assert "not UTF-8" in refusal(scan)


# ---- single images -----------------------------------------------------------------------------


@pytest.fixture
def jpeg(tmp_path):
    return picture(tmp_path / "a.jpg", size=(320, 240)).read_bytes()


def with_exif(jpeg, payload):
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def size_of(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    return image_size(tmp_path / name)


def test_truncated_jpegs(tmp_path, jpeg):
    assert size_of(tmp_path, "b.jpg", jpeg) == (320, 240)
    for end in (1, 10, len(jpeg) // 2, len(jpeg) - 2):
        assert size_of(tmp_path, "b.jpg", jpeg[:end]) is None


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image(tmp_path, jpeg):
    whole = with_exif(jpeg, b"Exif\0\0 a thumbnail \xff\xd8\xff\xd9")
    assert size_of(tmp_path, "b.jpg", whole) == (320, 240)
    assert images._whole_jpeg(whole)  # itself: some versions of OpenCV refuse what others fill
    assert not images._whole_jpeg(whole[: len(whole) // 2])


def test_what_phones_append_is_passed_by(tmp_path, jpeg):
    assert size_of(tmp_path, "b.jpg", jpeg + bytes(100_000)) == (320, 240)


def test_truncated_and_damaged_pngs(tmp_path):
    data = picture(tmp_path / "a.png", size=(320, 240)).read_bytes()
    assert size_of(tmp_path, "b.png", data + b"trailing") == (320, 240)
    assert size_of(tmp_path, "b.png", data[: len(data) // 2]) is None
    assert size_of(tmp_path, "b.png", data[:-12]) is None  # IEND alone is missing
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    assert size_of(tmp_path, "b.png", bytes(flipped)) is None
    assert images._whole_png(data) and not images._whole_png(bytes(flipped))  # itself, see above


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_every_format_is_read_alike_by_colmap(tmp_path, suffix):
    pycolmap = pytest.importorskip("pycolmap")
    path = picture(tmp_path / f"a{suffix}", size=(64, 48))
    assert image_size(path) == (64, 48)
    bitmap = pycolmap.Bitmap.read(str(path), False)
    assert (bitmap.width, bitmap.height) == (64, 48)


@pytest.mark.parametrize("kind", ["16 bit", "alpha", "rotated by EXIF", "grey"])
def test_odd_images_have_the_size_that_colmap_sees(tmp_path, kind):
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    path = tmp_path / "a.png"
    if kind == "16 bit":
        cv2.imwrite(str(path), rng.integers(0, 65535, (48, 64), np.uint16))
    elif kind == "alpha":
        cv2.imwrite(str(path), rng.integers(0, 255, (48, 64, 4), np.uint8))
    elif kind == "grey":
        cv2.imwrite(str(path), rng.integers(0, 255, (48, 64), np.uint8))
    else:
        upright = picture(tmp_path / "b.jpg", size=(64, 48)).read_bytes()
        turned = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x0112, 3, 1, 6) + bytes(4)
        path = tmp_path / "a.jpg"
        path.write_bytes(with_exif(upright, turned))
        assert cv2.imread(str(path)).shape[:2] == (64, 48)  # the tag is understood
    bitmap = pycolmap.Bitmap.read(str(path), False)
    assert image_size(path) == (bitmap.width, bitmap.height) == (64, 48)
