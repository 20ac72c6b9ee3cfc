import gzip

import nibabel
import numpy as np
import pytest

from octn_ros.errors import VolumeError
from octn_ros.volume import Volume, load_volume, save_volume

SPACING = (28e-6, 14.59e-6, 14e-6)
SPACING_UM = (28.0, 14.59, 14.0)


@pytest.fixture
def volume():
    rng = np.random.default_rng(1)
    return Volume.from_array(
        rng.integers(0, 4096, (4, 5, 6), dtype=np.uint16),
        SPACING,
        intensity_range=(0, 4095),
        intensity_scale="log",
        origin_m=(1e-3, -2e-3, 5e-4),
        stamp_ns=1_700_000_000_123_456_789,
    )


@pytest.mark.parametrize("name", ["scan.nii", "scan.nii.gz"])
def test_round_trip_keeps_everything(tmp_path, volume, name):
    save_volume(tmp_path / name, volume)
    back = load_volume(tmp_path / name)
    np.testing.assert_array_equal(back.array, volume.array)
    assert back.array.dtype == volume.array.dtype
    np.testing.assert_allclose(back.geometry.spacing_m, SPACING, rtol=1e-6)
    np.testing.assert_allclose(back.geometry.origin_m, volume.geometry.origin_m)
    assert back.intensity_range == (0, 4095)
    assert back.intensity_scale == "log"
    assert back.stamp_ns == volume.stamp_ns


def test_affine_places_voxels_in_the_oct_frame(tmp_path, volume):
    save_volume(tmp_path / "scan.nii", volume)
    affine = nibabel.load(tmp_path / "scan.nii").affine
    expected = volume.geometry.voxel_to_metric(np.array([3.0, 2.0, 1.0])) * 1e3
    np.testing.assert_allclose(affine @ [3, 2, 1, 1], [*expected, 1], rtol=1e-5)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e-3), ("micron", 1e-6), ("meter", 1.0)])
def test_foreign_files_state_their_unit(tmp_path, unit, factor):
    image = nibabel.Nifti1Image(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), np.diag([0.5, 0.25, 0.125, 1]))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "scan.nii")
    geometry = load_volume(tmp_path / "scan.nii").geometry
    np.testing.assert_allclose(geometry.spacing_m, np.array([0.5, 0.25, 0.125]) * factor, rtol=1e-6)


def unstated(path):
    nibabel.save(nibabel.Nifti1Image(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), np.eye(4)), path)
    return path


def test_unstated_spacing_is_never_guessed(tmp_path):
    path = unstated(tmp_path / "scan.nii")
    with pytest.raises(VolumeError, match="--spacing-um BSCAN AXIAL LATERAL"):
        load_volume(path)
    np.testing.assert_allclose(load_volume(path, SPACING_UM).geometry.spacing_m, SPACING)


def test_scaled_integers_are_read_as_their_meaning(tmp_path):
    image = nibabel.Nifti1Image(np.arange(60, dtype=np.float32).reshape(3, 4, 5) / 10, np.eye(4))
    image.set_data_dtype(np.uint8)
    nibabel.save(image, tmp_path / "scan.nii")
    assert load_volume(tmp_path / "scan.nii", SPACING_UM).array.max() == pytest.approx(5.9, abs=0.05)


def test_fourth_axis_of_one_is_dropped(tmp_path):
    image = nibabel.Nifti1Image(np.arange(60, dtype=np.uint8).reshape(3, 4, 5, 1), np.eye(4))
    nibabel.save(image, tmp_path / "scan.nii")
    assert load_volume(tmp_path / "scan.nii", SPACING_UM).array.shape == (3, 4, 5)


@pytest.mark.parametrize("spacing", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
def test_spacing_that_is_not_positive_is_refused(tmp_path, spacing):
    with pytest.raises(VolumeError, match="positive spacings"):
        load_volume(unstated(tmp_path / "scan.nii"), spacing)


def test_missing_and_empty_files(tmp_path):
    with pytest.raises(VolumeError, match="no such file"):
        load_volume(tmp_path / "nothing.nii")
    (tmp_path / "empty.nii.gz").touch()
    with pytest.raises(VolumeError, match="empty"):
        load_volume(tmp_path / "empty.nii.gz")


@pytest.mark.parametrize("name", ["scan.nii", "scan.nii.gz"])
def test_every_truncation_is_an_error_that_names_the_file(tmp_path, volume, name):
    path = tmp_path / name
    save_volume(path, volume)
    whole = path.read_bytes()
    for length in range(1, len(whole) - 8, 17):
        path.write_bytes(whole[:length])
        with pytest.raises(VolumeError, match=name):
            load_volume(path)


def test_other_content_is_an_error(tmp_path):
    (tmp_path / "text.nii").write_text("not an image, only words " * 40)
    with pytest.raises(VolumeError, match="NIfTI"):
        load_volume(tmp_path / "text.nii")
    (tmp_path / "text.nii.gz").write_bytes(gzip.compress(b"words " * 400))
    with pytest.raises(VolumeError, match="NIfTI"):
        load_volume(tmp_path / "text.nii.gz")


def test_flat_images_are_refused(tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 4), np.uint8), np.eye(4)), tmp_path / "flat.nii")
    with pytest.raises(VolumeError, match="three axes"):
        load_volume(tmp_path / "flat.nii", SPACING_UM)


def test_unwritable_path(tmp_path, volume):
    with pytest.raises(VolumeError, match="cannot write"):
        save_volume(tmp_path / "no" / "folder.nii", volume)
