"""What is done to a volume before it is fitted: axes, signs, normalisation, scale, crops, subsampling, filters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.volume import (
    Normalisation,
    Volume,
    crop,
    gaussian_filter_of_size,
    load_volume,
    median_filter,
    subsample_bscans,
    to_log_scale,
)

SPACING_M = (28e-6, 14.59e-6, 14e-6)
SPACING_UM = (28.0, 14.59, 14.0)
ORIGIN_M = (1e-3, -2e-3, 3e-3)


def volume(array=None, **more):
    array = np.random.default_rng(5).integers(0, 250, (7, 8, 9)).astype(np.uint8) if array is None else array
    return Volume.from_array(array, SPACING_M, origin_m=ORIGIN_M, stamp_ns=5, **more)


# --- axes and directions


@pytest.mark.parametrize(
    "axes", [("axial", "lateral", "bscan"), ("lateral", "axial", "bscan"), ("bscan", "lateral", "axial")]
)
def test_axes_in_any_order_become_ours(tmp_path, axes):
    scan = volume().array
    np.save(tmp_path / "scan.npy", scan.transpose([("bscan", "axial", "lateral").index(axis) for axis in axes]))
    back = load_volume(tmp_path / "scan.npy", SPACING_UM, axes=axes)
    np.testing.assert_array_equal(back.array, scan)
    assert back.geometry.spacing_m == pytest.approx(SPACING_M)


def test_a_stated_spacing_follows_its_axes(tmp_path):
    scan = volume().array
    np.savez(tmp_path / "scan.npz", volume=scan.transpose(1, 2, 0), spacing_um=np.array([14.59, 14.0, 28.0]))
    back = load_volume(tmp_path / "scan.npz", axes=("axial", "lateral", "bscan"))
    np.testing.assert_array_equal(back.array, scan)
    assert back.geometry.spacing_m == pytest.approx(SPACING_M)


@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, 1, -1)])
def test_a_mirrored_axis_is_turned_round(tmp_path, signs):
    scan = volume().array
    np.save(tmp_path / "scan.npy", scan[tuple(slice(None, None, sign) for sign in signs)])
    back = load_volume(tmp_path / "scan.npy", SPACING_UM, scan_signs=signs)
    np.testing.assert_array_equal(back.array, scan)
    assert back.array.flags.c_contiguous


@pytest.mark.parametrize(
    "wrong",
    [
        {"axes": ("x", "y", "z")},
        {"axes": ("bscan", "bscan", "axial")},
        {"scan_signs": (1, 1)},
        {"scan_signs": (1, 0, 1)},
        {"intensity_scale": "loud"},
    ],
)
def test_wrong_declarations_are_refused(tmp_path, wrong):
    np.save(tmp_path / "scan.npy", volume().array)
    with pytest.raises((ConfigurationError, VolumeError), match="expected"):
        load_volume(tmp_path / "scan.npy", SPACING_UM, **wrong)


# --- normalisation and scale


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
def test_percentiles_are_those_of_numpy(tmp_path, dtype):
    scan = (np.random.default_rng(6).random((7, 8, 9)) * 200 - (50 if dtype == np.int16 else 0)).astype(dtype)
    np.save(tmp_path / "scan.npy", scan)
    back = load_volume(tmp_path / "scan.npy", SPACING_UM, normalisation=Normalisation("percentile", 5, 90))
    expected = np.percentile(scan.astype(float), (5, 90), method="linear" if dtype == np.float32 else "inverted_cdf")
    assert back.intensity_range == pytest.approx(tuple(expected), rel=1e-6)
    np.testing.assert_array_equal(back.array, scan)  # raw values stay, only their meaning changes
    assert np.mean(back.normalized() == 0.0) == pytest.approx(0.05, abs=0.02)


def test_minmax_and_type(tmp_path):
    scan = np.random.default_rng(7).integers(-100, 1000, (4, 5, 6)).astype(np.int16)
    np.save(tmp_path / "scan.npy", scan)

    def range_by(kind):
        return load_volume(tmp_path / "scan.npy", SPACING_UM, normalisation=Normalisation(kind)).intensity_range

    assert range_by("minmax") == (scan.min(), scan.max())
    assert range_by("type") == (-32768, 32767)


def test_floats_have_no_type_range_unless_they_lie_in_0_to_1(tmp_path):
    scan = np.random.default_rng(8).random((4, 5, 6), dtype=np.float32)
    np.save(tmp_path / "scan.npy", scan)
    np.save(tmp_path / "wide.npy", scan * 7)
    by_type = Normalisation("type")
    assert load_volume(tmp_path / "scan.npy", SPACING_UM, normalisation=by_type).intensity_range == (0, 1)
    with pytest.raises(VolumeError, match="choose minmax or percentile"):
        load_volume(tmp_path / "wide.npy", SPACING_UM, normalisation=by_type)


@pytest.mark.parametrize(
    "wrong", [("median",), ("percentile", 90.0, 10.0), ("percentile", -1.0, 10.0), ("percentile", 5, 5)]
)
def test_wrong_normalisations_are_refused(wrong):
    with pytest.raises(ConfigurationError, match="expected"):
        Normalisation(*wrong)


def test_percentiles_that_coincide_are_refused(tmp_path):
    scan = np.zeros((4, 5, 6), np.uint8)
    scan[0, 0, 0] = 9
    np.save(tmp_path / "scan.npy", scan)
    with pytest.raises(VolumeError, match="gives 0 twice"):
        load_volume(tmp_path / "scan.npy", SPACING_UM, normalisation=Normalisation("percentile", 1, 50))


def test_decibels_by_hand():
    linear = np.array([1.0, 0.1, 0.01, 0.001, 0.0, 0.5, 1.0, 1.0], np.float32).reshape(2, 2, 2)
    log = to_log_scale(volume(linear, intensity_scale="linear"), 20.0)
    np.testing.assert_allclose(log.array.ravel(), [0, -10, -20, -20, -20, -3.0103, 0, 0], atol=1e-4)
    assert (log.intensity_range, log.intensity_scale) == ((-20.0, 0.0), "log")
    np.testing.assert_allclose(log.normalized().ravel()[:3], [1.0, 0.5, 0.0], atol=1e-6)
    assert log.geometry == volume(linear).geometry


@pytest.mark.parametrize("scale", ["log", "unknown"])
def test_decibels_of_what_is_not_declared_linear_are_refused(scale):
    with pytest.raises(VolumeError, match="--scale linear"):
        to_log_scale(volume(intensity_scale=scale), 40.0)
    with pytest.raises(ConfigurationError, match="dynamic range"):
        to_log_scale(volume(intensity_scale="linear"), 0.0)


# --- crops and subsampling


@given(st.tuples(*[st.tuples(st.integers(0, 5), st.integers(2, 7))] * 3))
def test_a_cropped_voxel_stays_where_it_was(spans):
    whole = volume()
    spans = [(start, min(start + count, n)) for (start, count), n in zip(spans, whole.geometry.shape, strict=True)]
    part = crop(whole, *spans)
    index = np.array(part.geometry.shape) - 1
    in_whole = index + [start for start, _ in spans]
    assert part.array[tuple(index)] == whole.array[tuple(in_whole)]
    np.testing.assert_allclose(
        part.geometry.voxel_to_metric(index.astype(float)),
        whole.geometry.voxel_to_metric(in_whole.astype(float)),
        atol=1e-12,
    )
    assert (part.stamp_ns, part.geometry.spacing_m) == (5, SPACING_M)


@pytest.mark.parametrize("span", [(-1, 3), (0, 8), (3, 4), (5, 2)])
def test_crops_outside_are_refused(span):
    with pytest.raises(VolumeError, match="at least two bscan indices"):
        crop(volume(), bscan=span)


@pytest.mark.parametrize(
    ("factor", "kept", "held_out", "beyond"),
    [
        (1, (0, 1, 2, 3, 4, 5, 6), (), ()),
        (2, (0, 2, 4, 6), (1, 3, 5), ()),
        (4, (0, 4), (1, 2, 3), (5, 6)),
        (6, (0, 6), (1, 2, 3, 4, 5), ()),
    ],
)
def test_sparse_protocol_by_hand(factor, kept, held_out, beyond):
    dense = volume()
    sparse = subsample_bscans(dense, factor)
    assert (sparse.kept, sparse.held_out, sparse.beyond) == (kept, held_out, beyond)
    np.testing.assert_array_equal(sparse.volume.array, dense.array[list(kept)])
    assert sparse.volume.geometry.spacing_m == (28e-6 * factor, 14.59e-6, 14e-6)
    # The last kept B-scan lies where it lay.
    last = sparse.volume.geometry.voxel_to_metric(np.array([len(kept) - 1.0, 0, 0]))
    np.testing.assert_allclose(last, dense.geometry.voxel_to_metric(np.array([float(kept[-1]), 0, 0])))


@pytest.mark.parametrize("factor", [0, -2, 7])
def test_factors_that_leave_no_scan_are_refused(factor):
    with pytest.raises(VolumeError, match="expected a factor of 1 to 6"):
        subsample_bscans(volume(), factor)


# --- filters of size 3


def test_the_gaussian_of_size_3_is_opencvs_kernel():
    impulse = np.zeros((7, 7, 7), np.float32)
    impulse[3, 3, 3] = 1.0
    smooth = gaussian_filter_of_size(volume(impulse)).array
    line = np.array([0.23899427, 0.52201147, 0.23899427])  # cv2.getGaussianKernel(3, 0), sigma 0.8
    np.testing.assert_allclose(smooth[2:5, 2:5, 2:5], np.einsum("i,j,k->ijk", line, line, line), atol=1e-6)
    assert np.count_nonzero(smooth) == 27


def test_the_median_of_size_3_by_hand():
    scan = np.zeros((5, 5, 5), np.uint8)
    scan[1:4, 1:4, 1:4] = np.arange(27, dtype=np.uint8).reshape(3, 3, 3) * 5
    scan[2, 2, 2] = 255  # a speckle in the middle of 0, 5, ..., 130 without 65: the median is 70
    calm = median_filter(volume(scan))
    assert calm.array[2, 2, 2] == 70
    assert calm.array.dtype == np.uint8
    assert calm.geometry == volume(scan).geometry
    assert calm.intensity_range == (0, 255)


@pytest.mark.parametrize("smooth", [gaussian_filter_of_size, median_filter])
@pytest.mark.parametrize("size", [0, 1, 2, 4, -3])
def test_even_sizes_are_refused(smooth, size):
    with pytest.raises(ConfigurationError, match="odd filter size"):
        smooth(volume(), size)
