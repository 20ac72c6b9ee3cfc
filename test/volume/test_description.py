"""What a file says of its C-scan without its voxels agrees with the C-scan, and costs next to nothing."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numpy as np
import pydicom
import pytest
import scipy.io
import tifffile
from numpy.typing import NDArray
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset

from octn_ros.errors import VolumeError
from octn_ros.volume import Volume, describe_scan, load_volume, save_volume

SPACING_UM = (28.0, 14.59, 14.0)
SPACING_M = (28e-6, 14.59e-6, 14e-6)


def _own(path: Path, array: NDArray[Any]) -> None:
    save_volume(path, Volume.from_array(array, SPACING_M, intensity_scale="log", stamp_ns=7, origin_m=(1e-3, 0, 0)))


def _folder(path: Path, array: NDArray[Any]) -> None:
    path.mkdir()
    for index, image in enumerate(array):
        Image.fromarray(image).save(path / f"{index}.png")


def _hdf5(path: Path, array: NDArray[Any]) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("volume", data=array, chunks=array.shape, compression="gzip")
        file["spacing_um"] = SPACING_UM


def _dicom(path: Path, array: NDArray[Any], slope: float | None = None) -> None:
    data_set = Dataset()
    data_set.file_meta = FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data_set.SOPClassUID = data_set.file_meta.MediaStorageSOPClassUID = pydicom.uid.OphthalmicTomographyImageStorage
    data_set.SOPInstanceUID = data_set.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    data_set.NumberOfFrames, data_set.Rows, data_set.Columns = array.shape
    data_set.SamplesPerPixel, data_set.PhotometricInterpretation, data_set.PixelRepresentation = 1, "MONOCHROME2", 0
    data_set.BitsAllocated = data_set.BitsStored = 8 * array.itemsize
    data_set.HighBit = data_set.BitsStored - 1
    if slope is not None:
        data_set.RescaleSlope, data_set.RescaleIntercept = slope, 3.0
    data_set.PixelData = array.tobytes()
    pydicom.dcmwrite(path, data_set, enforce_file_format=True)


WRITERS: dict[str, Callable[[Path, NDArray[Any]], Any]] = {
    "scan.nii": _own,
    "scan.nii.gz": _own,
    "scan.npz": _own,
    "scan.tif": _own,
    "scaled.nii": lambda path, array: nibabel.save(nibabel.Nifti1Image(array.astype(np.int16), np.eye(4)), path),
    "scan.npy": lambda path, array: np.save(path, array),
    "floats.npy": lambda path, array: np.save(path, array.astype(np.float64)),
    "packed.npz": lambda path, array: np.savez_compressed(path, scan=array, spacing_um=np.array(SPACING_UM)),
    "packed.tif": lambda path, array: tifffile.imwrite(path, array, photometric="minisblack", compression="zlib"),
    "folder": _folder,
    "scan.mat": lambda path, array: scipy.io.savemat(path, {"scan": array}, do_compression=True),
    "scan.h5": _hdf5,
    "scan.dcm": _dicom,
    "scaled.dcm": lambda path, array: _dicom(path, array, slope=0.5),
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("name", WRITERS)
def test_a_description_is_that_of_the_volume(tmp_path: Path, name: str, dtype: type) -> None:
    path = tmp_path / name
    WRITERS[name](path, np.random.default_rng(1).integers(0, 250, (4, 5, 6)).astype(dtype))
    told, volume = describe_scan(path, SPACING_UM), load_volume(path, SPACING_UM)
    assert told.geometry == volume.geometry
    assert told.dtype == (None if name == "scan.mat" else volume.array.dtype)
    assert told.intensity_range == (None if name in ("scan.mat", "floats.npy") else volume.intensity_range)
    assert (told.intensity_scale, told.stamp_ns) == (volume.intensity_scale, volume.stamp_ns)


def test_axes_scale_and_the_files_own_spacing_are_followed(tmp_path: Path) -> None:
    array = np.random.default_rng(1).integers(0, 250, (4, 5, 6)).astype(np.uint8)
    _own(tmp_path / "scan.nii", array)
    order = ("axial", "lateral", "bscan")
    told = describe_scan(tmp_path / "scan.nii", axes=order, intensity_scale="linear")
    volume = load_volume(tmp_path / "scan.nii", axes=order, intensity_scale="linear")
    assert told.geometry == volume.geometry
    assert told.geometry.shape == (6, 4, 5)
    assert told.intensity_scale == "linear"


@pytest.mark.parametrize("name", WRITERS)
def test_no_voxel_is_read_for_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    array = np.random.default_rng(1).integers(0, 250, (16, 512, 512)).astype(np.uint8)  # 4 MiB that do not compress
    WRITERS[name](path, array)
    describe_scan(path, SPACING_UM)  # imports are not counted
    tracemalloc.start()
    try:
        describe_scan(path, SPACING_UM)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < array.nbytes / 4


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((4, 5), np.uint8), "three axes"),
        (np.zeros((4, 5, 6), np.complex64), "real intensities"),
        (np.zeros((4, 5, 1), np.uint8), "at least 2"),
    ],
)
def test_what_is_no_scan_is_refused(tmp_path: Path, array: NDArray[Any], words: str) -> None:
    np.save(tmp_path / "scan.npy", array)
    with pytest.raises(VolumeError, match=rf"scan\.npy: .*{words}"):
        describe_scan(tmp_path / "scan.npy", SPACING_UM)


def test_what_is_unstated_too_large_or_missing_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.zeros((4, 5, 6), np.uint8))
    describe_scan(tmp_path / "scan.npy", SPACING_UM, max_voxels=120)
    with pytest.raises(VolumeError, match="at most 119 voxels"):
        describe_scan(tmp_path / "scan.npy", SPACING_UM, max_voxels=119)
    with pytest.raises(VolumeError, match="--spacing-um"):
        describe_scan(tmp_path / "scan.npy")
    with pytest.raises(VolumeError, match="no such file"):
        describe_scan(tmp_path / "none.npy", SPACING_UM)
