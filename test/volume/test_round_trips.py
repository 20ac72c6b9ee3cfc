"""What is written is read back exactly, whatever the format; files are replaced whole or not at all."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from octn_ros.errors import VolumeError
from octn_ros.volume import Volume, load_volume, save_volume

SUFFIXES = (".nii", ".nii.gz", ".npz", ".tif", ".tiff")
finite = st.floats(-1e3, 1e3, allow_nan=False)
spacings = st.floats(1e-7, 1e-3)


@st.composite
def volumes(draw):
    shape = draw(st.tuples(*[st.integers(2, 6)] * 3))
    dtype = draw(st.sampled_from([np.uint8, np.uint16, np.float32]))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    array = (generator.random(shape) * 250).astype(dtype)
    array.flat[0], array.flat[1] = 0, 251  # never constant
    low = draw(finite)
    return Volume.from_array(
        array,
        draw(st.tuples(*[spacings] * 3)),
        intensity_range=(low, low + draw(st.floats(1e-3, 1e5))),
        intensity_scale=draw(st.sampled_from(["linear", "log", "unknown"])),
        origin_m=draw(st.tuples(*[finite] * 3)),
        stamp_ns=draw(st.integers(0, 2**63 - 1)),
        frame=draw(st.sampled_from(["oct_optical_frame", "left/oct_optical_frame", "Rahmen für µm"])),
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(volume=volumes())
def test_everything_survives(tmp_path, suffix, volume):
    path = tmp_path / f"scan{suffix}"
    save_volume(path, volume)
    back = load_volume(path)
    np.testing.assert_array_equal(back.array, volume.array)
    assert back.array.dtype == volume.array.dtype
    assert back.geometry == volume.geometry  # to the last bit
    assert back.intensity_range == volume.intensity_range
    assert (back.intensity_scale, back.stamp_ns) == (volume.intensity_scale, volume.stamp_ns)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@given(volume=volumes(), order=st.permutations(SUFFIXES))
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_chain_of_formats_loses_nothing(tmp_path, volume, order):
    back = volume
    for index, suffix in enumerate(order):
        save_volume(tmp_path / f"{index}{suffix}", back)
        back = load_volume(tmp_path / f"{index}{suffix}")
    np.testing.assert_array_equal(back.array, volume.array)
    assert (back.geometry, back.intensity_range) == (volume.geometry, volume.intensity_range)
    assert (back.intensity_scale, back.stamp_ns) == (volume.intensity_scale, volume.stamp_ns)


def test_spacing_changed_by_another_program_is_believed(tmp_path):
    # Our comment holds the spacing exactly, but a header that says otherwise was written later.
    import nibabel

    volume = Volume.from_array(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), (3e-5, 2e-5, 1e-5))
    save_volume(tmp_path / "scan.nii", volume)
    image = nibabel.load(tmp_path / "scan.nii")
    image.header.set_zooms((0.06, 0.02, 0.01))
    changed = nibabel.Nifti1Image(np.asarray(image.dataobj), None, image.header)
    nibabel.save(changed, tmp_path / "changed.nii")
    assert load_volume(tmp_path / "changed.nii").geometry.spacing_m == pytest.approx((6e-5, 2e-5, 1e-5))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"scan{suffix}"
    path.write_bytes(b"what was there")
    volume = Volume.from_array(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), (3e-5, 2e-5, 1e-5))

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(VolumeError, match=r"cannot write the volume: .*No space left"):
        save_volume(path, volume)
    assert path.read_bytes() == b"what was there"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("name", ["scan.mat", "scan", "scan.nii.bz2"])
def test_formats_that_are_not_written(tmp_path, name):
    volume = Volume.from_array(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), (3e-5, 2e-5, 1e-5))
    with pytest.raises(VolumeError, match=r"expected one of the suffixes \.nii, \.nii\.gz, \.npz, \.tif, \.tiff"):
        save_volume(tmp_path / name, volume)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "header",
    [
        '"intensity_range": ["a", 1]',
        '"origin_m": [1e999, 0, 0]',
        '"frame": 7',
        '"stamp_ns": -1',
        '"intensity_scale": 3',
    ],
)
def test_a_header_of_no_use_is_told(tmp_path, header):
    import tifffile

    description = f'{{"octn_volume": {{{header}}}}}'
    array = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)
    tifffile.imwrite(tmp_path / "scan.tif", array, photometric="minisblack", description=description, metadata=None)
    with pytest.raises(VolumeError, match=header.split('"')[1]):
        load_volume(tmp_path / "scan.tif", (30.0, 20.0, 10.0))
