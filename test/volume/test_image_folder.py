"""Folders of numbered images: order, gaps, changes, and the file that is to blame."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from octn_ros.errors import VolumeError
from octn_ros.volume import load_volume

SPACING_UM = (28.0, 14.59, 14.0)
ARRAY = np.random.default_rng(4).integers(0, 256, (12, 6, 5)).astype(np.uint8)


def save(folder, array=ARRAY, suffix="png", first=1, name="scan_{}"):
    for index, bscan in enumerate(array):
        Image.fromarray(bscan).save(folder / f"{name.format(first + index)}.{suffix}")


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        *(("png", np.uint8), ("png", np.uint16), ("bmp", np.uint8), ("pgm", np.uint8), ("pgm", np.uint16)),
        *(("tif", np.uint8), ("tiff", np.uint16), ("tif", np.float32)),
    ],
)
def test_images_are_sorted_as_numbers(tmp_path, suffix, dtype):
    save(tmp_path, ARRAY.astype(dtype), suffix)  # scan_10 comes before scan_2 as a word
    (tmp_path / "notes.txt").write_text("not an image")
    (tmp_path / ".hidden.png").write_text("not an image")
    volume = load_volume(tmp_path, SPACING_UM)
    np.testing.assert_array_equal(volume.array, ARRAY)
    assert volume.array.dtype == dtype
    assert volume.geometry.spacing_m == pytest.approx([s * 1e-6 for s in SPACING_UM])


@pytest.mark.parametrize("name", ["{}", "{:05d}", "eye2_scan_{:03d}", "frame {} of scan"])
def test_the_last_number_in_a_name_counts(tmp_path, name):
    save(tmp_path, name=name, first=0)
    np.testing.assert_array_equal(load_volume(tmp_path, SPACING_UM).array, ARRAY)


def test_grey_in_colour_is_taken_and_colour_is_not(tmp_path):
    for index, bscan in enumerate(ARRAY):
        Image.fromarray(np.stack([bscan] * 3, axis=-1)).save(tmp_path / f"{index}.png")
    np.testing.assert_array_equal(load_volume(tmp_path, SPACING_UM).array, ARRAY)
    red = np.zeros((6, 5, 3), np.uint8)
    red[..., 0] = 200
    Image.fromarray(red).save(tmp_path / "7.png")
    with pytest.raises(VolumeError, match=r"7\.png: expected a grey image"):
        load_volume(tmp_path, SPACING_UM)


def spoil_gap(folder):
    (folder / "scan_7.png").unlink()
    return r"scan_8\.png: a gap in the numbering, expected B-scan 7 after scan_6\.png"


def spoil_size(folder):
    Image.fromarray(ARRAY[0, :-1]).save(folder / "scan_5.png")
    return r"scan_5\.png: expected an image of \(6, 5\) and uint8 like scan_1\.png, got \(5, 5\)"


def spoil_type(folder):
    Image.fromarray(ARRAY[0].astype(np.uint16)).save(folder / "scan_5.png")
    return r"scan_5\.png: expected an image of .* uint8 like scan_1\.png, got .* uint16"


def spoil_name(folder):
    Image.fromarray(ARRAY[0]).save(folder / "enface_1.png")
    return r"scan_1\.png: expected a name like enface_<number>\.png"


def spoil_number(folder):
    Image.fromarray(ARRAY[0]).save(folder / "fundus.png")
    return r"fundus\.png: expected a number in the name"


def spoil_repeated(folder):
    Image.fromarray(ARRAY[0]).save(folder / "scan_03.png")
    return r"scan_3\.png: B-scan 3 is there already, in scan_03\.png"


def spoil_image(folder):
    whole = (folder / "scan_9.png").read_bytes()
    (folder / "scan_9.png").write_bytes(whole[: len(whole) // 2])
    return r"scan_9\.png: the image is damaged"


def spoil_all(folder):
    for image in folder.glob("*.png"):
        image.unlink()
    return "expected a folder of numbered images"


@pytest.mark.parametrize(
    "spoil",
    [spoil_gap, spoil_size, spoil_type, spoil_name, spoil_number, spoil_repeated, spoil_image, spoil_all],
)
def test_the_file_to_blame_is_named(tmp_path, spoil):
    save(tmp_path)
    with pytest.raises(VolumeError, match=spoil(tmp_path)):
        load_volume(tmp_path, SPACING_UM)


def test_stacks_are_no_single_images(tmp_path):
    for index in range(3):
        tifffile.imwrite(tmp_path / f"{index}.tif", ARRAY[:2], photometric="minisblack")
    with pytest.raises(VolumeError, match=r"0\.tif: expected one image, got 2 pages"):
        load_volume(tmp_path, SPACING_UM)


def test_spacing_is_never_guessed(tmp_path):
    save(tmp_path)
    with pytest.raises(VolumeError, match="--spacing-um BSCAN AXIAL LATERAL"):
        load_volume(tmp_path)
