"""Every format, read from a file that its own library has written."""

import struct

import h5py
import numpy as np
import pydicom
import pytest
import scipy.io
import tifffile
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, OphthalmicTomographyImageStorage

from octn_ros.errors import VolumeError
from octn_ros.volume import load_volume

SPACING_UM = (28.0, 14.59, 14.0)


def voxels(dtype=np.uint16, shape=(4, 5, 6)):
    return np.random.default_rng(3).integers(0, 200, shape).astype(dtype)


def check(volume, array, rtol=1e-6):
    np.testing.assert_array_equal(volume.array, array)
    np.testing.assert_allclose(np.array(volume.geometry.spacing_m) * 1e6, SPACING_UM, rtol=rtol)


# --- NumPy


@pytest.mark.parametrize("dtype", ["u1", "u2", ">u2", "f4"])
@pytest.mark.parametrize("order", "CF")
def test_npy_keeps_its_type_and_its_order_does_not_matter(tmp_path, dtype, order):
    array = voxels(dtype)
    np.save(tmp_path / "scan.npy", np.asarray(array, order=order))
    volume = load_volume(tmp_path / "scan.npy", SPACING_UM)
    check(volume, array)
    assert volume.array.dtype == np.dtype(dtype).newbyteorder("=")
    with pytest.raises(VolumeError, match="--spacing-um"):
        load_volume(tmp_path / "scan.npy")


def test_npy_is_mapped_and_not_copied(tmp_path):
    np.save(tmp_path / "scan.npy", voxels())
    array = load_volume(tmp_path / "scan.npy", SPACING_UM).array
    while array.base is not None and not isinstance(array, np.memmap):
        array = array.base
    assert isinstance(array, np.memmap)
    assert not array.flags.writeable


@pytest.mark.parametrize("dtype", [np.int16, np.float64, np.int32])
def test_other_types_become_single_floats(tmp_path, dtype):
    np.save(tmp_path / "scan.npy", voxels(dtype))
    volume = load_volume(tmp_path / "scan.npy", SPACING_UM)
    check(volume, voxels(dtype))
    assert volume.array.dtype == np.float32


def test_pickles_are_never_loaded(tmp_path):
    np.save(tmp_path / "scan.npy", np.array([[[{}]]], object))
    np.savez(tmp_path / "scan.npz", volume=np.array([[[{}]]], object))
    for name in ("scan.npy", "scan.npz"):
        with pytest.raises(VolumeError, match="pickled"):
            load_volume(tmp_path / name, SPACING_UM)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_of_others(tmp_path, save):
    save(tmp_path / "scan.npz", scan=voxels(), other=np.arange(3))
    check(load_volume(tmp_path / "scan.npz", SPACING_UM), voxels())
    save(tmp_path / "scan.npz", volume=voxels(), mask=voxels(), spacing_um=np.array(SPACING_UM))
    check(load_volume(tmp_path / "scan.npz"), voxels())


def test_several_arrays_have_to_be_told_apart(tmp_path):
    np.savez(tmp_path / "scan.npz", before=voxels(), after=voxels() + 1)
    with pytest.raises(VolumeError, match=r"before \(4, 5, 6\), after \(4, 5, 6\); name one with --variable"):
        load_volume(tmp_path / "scan.npz", SPACING_UM)
    check(load_volume(tmp_path / "scan.npz", SPACING_UM, variable="after"), voxels() + 1)
    with pytest.raises(VolumeError, match="expected an array 'during'"):
        load_volume(tmp_path / "scan.npz", SPACING_UM, variable="during")


# --- TIFF


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("byteorder", "<>")
def test_tiff_pages(tmp_path, dtype, compression, byteorder):
    tifffile.imwrite(
        tmp_path / "scan.tif", voxels(dtype), photometric="minisblack", compression=compression, byteorder=byteorder
    )
    volume = load_volume(tmp_path / "scan.tif", SPACING_UM)
    check(volume, voxels(dtype))
    assert volume.array.dtype == dtype


def test_tiff_by_pillow(tmp_path):
    first, *others = [Image.fromarray(bscan) for bscan in voxels(np.uint8)]
    first.save(tmp_path / "scan.tiff", save_all=True, append_images=others, compression="packbits")
    check(load_volume(tmp_path / "scan.tiff", SPACING_UM), voxels(np.uint8))


@pytest.mark.parametrize("unit", ["micron", "um", "mm"])
def test_imagej_states_its_spacing(tmp_path, unit):
    bscan, axial, lateral = (s * (1e-3 if unit == "mm" else 1.0) for s in SPACING_UM)
    tifffile.imwrite(
        tmp_path / "scan.tif",
        voxels(),
        imagej=True,
        resolution=(1 / lateral, 1 / axial),
        metadata={"axes": "ZYX", "spacing": bscan, "unit": unit},
    )
    check(load_volume(tmp_path / "scan.tif"), voxels(), rtol=1e-4)  # tags hold ratios of 32-bit integers


def test_ome_states_its_spacing(tmp_path):
    sizes = dict(zip(("PhysicalSizeZ", "PhysicalSizeY", "PhysicalSizeX"), SPACING_UM, strict=True))
    tifffile.imwrite(tmp_path / "scan.ome.tif", voxels(), metadata={"axes": "ZYX", **sizes})
    check(load_volume(tmp_path / "scan.ome.tif"), voxels())


def test_dots_per_inch_are_no_spacing(tmp_path):
    tifffile.imwrite(tmp_path / "scan.tif", voxels(), photometric="minisblack", resolution=(72, 72), resolutionunit=2)
    with pytest.raises(VolumeError, match="--spacing-um"):
        load_volume(tmp_path / "scan.tif")


@pytest.mark.parametrize(
    "options",
    [{"photometric": "minisblack"}, {"imagej": True}, {"ome": True}, {"bigtiff": True, "photometric": "minisblack"}],
)
def test_a_truncated_tiff_never_has_fewer_bscans(tmp_path, options):
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, voxels(), metadata={"axes": "ZYX"}, **options)
    whole = path.read_bytes()
    refused = 0
    for length in range(8, len(whole), 11):
        path.write_bytes(whole[:length])
        try:
            volume = load_volume(path, SPACING_UM)
        except VolumeError:
            refused += 1
        else:  # what was cut off holds no voxels, a description for instance
            check(volume, voxels())
    assert refused > 0


def test_tiff_pages_have_to_be_alike_and_grey(tmp_path):
    with tifffile.TiffWriter(tmp_path / "scan.tif") as writer:
        for bscan in (*voxels(), np.zeros((5, 7), np.uint16)):
            writer.write(bscan, photometric="minisblack")
    with pytest.raises(VolumeError, match=r"page 4: expected \(5, 6\) of uint16"):
        load_volume(tmp_path / "scan.tif", SPACING_UM)
    tifffile.imwrite(tmp_path / "colour.tif", np.zeros((4, 5, 3), np.uint8), photometric="rgb")
    with pytest.raises(VolumeError, match="grey image"):
        load_volume(tmp_path / "colour.tif", SPACING_UM)


# --- MATLAB and HDF5


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_matlab_5(tmp_path, compressed, dtype):
    stored = {"scan": voxels(dtype), "spacing_um": np.array(SPACING_UM), "note": "no array", "cell": {"a": 1}}
    scipy.io.savemat(tmp_path / "scan.mat", stored, do_compression=compressed)
    check(load_volume(tmp_path / "scan.mat"), voxels(dtype))


def save_matlab_73(path, array, spacing_um=None, **options):
    """As MATLAB does: 512 bytes of its own, axes reversed, its class as an attribute."""
    with h5py.File(path, "w", userblock_size=512) as file:
        dataset = file.create_dataset("scan", data=np.ascontiguousarray(array.T), **options)
        dataset.attrs["MATLAB_class"] = np.bytes_("uint16")
        if spacing_um is not None:
            file.create_dataset("spacing_um", data=np.array(spacing_um).reshape(3, 1)).attrs["MATLAB_class"] = b"double"
    with path.open("rb+") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116))


@pytest.mark.parametrize("options", [{}, {"chunks": (2, 3, 4), "compression": "gzip", "shuffle": True}])
def test_matlab_73_has_its_axes_as_matlab_shows_them(tmp_path, options):
    save_matlab_73(tmp_path / "scan.mat", voxels(), SPACING_UM, **options)
    check(load_volume(tmp_path / "scan.mat"), voxels())


def test_matlab_axes_in_another_order(tmp_path):
    # As MATLAB users mostly have it: (row, column, page) is (axial, lateral, bscan). Spacings follow the array's axes.
    bscan, axial, lateral = SPACING_UM
    stored = {"scan": voxels().transpose(1, 2, 0), "spacing_um": np.array([axial, lateral, bscan])}
    scipy.io.savemat(tmp_path / "scan.mat", stored)
    check(load_volume(tmp_path / "scan.mat", axes=("axial", "lateral", "bscan")), voxels())


def test_hdf5(tmp_path):
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["scan"], file["scan2"], file["group/deep"] = voxels(), voxels() + 1, voxels() + 2
    with pytest.raises(VolumeError, match="--variable"):
        load_volume(tmp_path / "scan.h5", SPACING_UM)
    check(load_volume(tmp_path / "scan.h5", SPACING_UM, variable="scan2"), voxels() + 1)
    check(load_volume(tmp_path / "scan.h5", SPACING_UM, variable="group/deep"), voxels() + 2)


def test_hdf5_links_to_other_files_are_not_followed(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(120))
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["other"] = h5py.ExternalLink("elsewhere.h5", "/scan")
    with pytest.raises(VolumeError, match="no array of numbers"):
        load_volume(tmp_path / "scan.h5", SPACING_UM)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file.create_dataset("scan", (4, 5, 6), "u1", external=[(str(tmp_path / "secret"), 0, 120)])
    with pytest.raises(VolumeError, match="not followed"):
        load_volume(tmp_path / "scan.h5", SPACING_UM)


# --- DICOM


def dicom(array, **attributes):
    """An ophthalmic tomography image with one shared functional group."""
    measures = Dataset()
    measures.PixelSpacing = [0.01459, 0.014]
    measures.SliceThickness = 0.5
    measures.SpacingBetweenSlices = 0.028
    shared = Dataset()
    shared.PixelMeasuresSequence = Sequence([measures])
    data_set = Dataset()
    data_set.file_meta = FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = attributes.pop("syntax", ExplicitVRLittleEndian)
    data_set.SOPClassUID = data_set.file_meta.MediaStorageSOPClassUID = OphthalmicTomographyImageStorage
    data_set.SOPInstanceUID = data_set.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    data_set.Modality = "OPT"
    data_set.NumberOfFrames, data_set.Rows, data_set.Columns = array.shape
    data_set.SamplesPerPixel, data_set.PhotometricInterpretation, data_set.PixelRepresentation = 1, "MONOCHROME2", 0
    data_set.BitsAllocated = data_set.BitsStored = 8 * array.dtype.itemsize
    data_set.HighBit = data_set.BitsStored - 1
    data_set.SharedFunctionalGroupsSequence = Sequence([shared])
    data_set.PixelData = array.tobytes()
    for name, value in attributes.items():
        setattr(data_set, name, value)
    return data_set


def save_dicom(data_set, path):
    pydicom.dcmwrite(path, data_set, enforce_file_format=True)
    return path


@pytest.mark.parametrize("name", ["scan.dcm", "scan"])
def test_dicom_ophthalmic_tomography(tmp_path, name):
    data_set = dicom(voxels(), BitsStored=12, HighBit=11, AcquisitionDateTime="20240102030405.5+0100")
    volume = load_volume(save_dicom(data_set, tmp_path / name))
    check(volume, voxels())
    assert volume.intensity_range == (0, 4095)
    assert volume.stamp_ns == 1_704_161_045_500_000_000


def test_dicom_slice_thickness_is_no_distance(tmp_path):
    data_set = dicom(voxels())
    del data_set.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices
    with pytest.raises(VolumeError, match="--spacing-um"):
        load_volume(save_dicom(data_set, tmp_path / "scan.dcm"))


def place_frames(data_set, positions):
    del data_set.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices
    frames = []
    for y in positions:
        plane, frame = Dataset(), Dataset()
        plane.ImagePositionPatient = [0, y, 0]
        frame.PlanePositionSequence = Sequence([plane])
        frames.append(frame)
    data_set.PerFrameFunctionalGroupsSequence = Sequence(frames)


def test_dicom_frame_positions_state_the_distance(tmp_path):
    data_set = dicom(voxels())
    place_frames(data_set, [0, 0.028, 0.056, 0.084])
    check(load_volume(save_dicom(data_set, tmp_path / "scan.dcm")), voxels())
    place_frames(dataset := dicom(voxels()), [0, 0.028, 0.066, 0.084])
    with pytest.raises(VolumeError, match="unevenly"):
        load_volume(save_dicom(dataset, tmp_path / "scan.dcm"))


def test_dicom_rescaling_and_signs(tmp_path):
    transformation = Dataset()
    transformation.RescaleSlope, transformation.RescaleIntercept = 0.5, -10
    data_set = dicom(voxels(np.int16) - 50, PixelRepresentation=1)
    data_set.SharedFunctionalGroupsSequence[0].PixelValueTransformationSequence = Sequence([transformation])
    volume = load_volume(save_dicom(data_set, tmp_path / "scan.dcm"))
    check(volume, (voxels(np.float32) - 50) * 0.5 - 10)
    assert volume.intensity_range == (-32768 * 0.5 - 10, 32767 * 0.5 - 10)


def test_dicom_run_length(tmp_path):
    data_set = dicom(voxels())
    data_set.compress(pydicom.uid.RLELossless)
    check(load_volume(save_dicom(data_set, tmp_path / "scan.dcm")), voxels())


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB", "PlanarConfiguration": 0}, "grey image"),
        ({"Rows": 60_000, "Columns": 60_000}, "damaged or truncated"),
        ({"syntax": DeflatedExplicitVRLittleEndian}, "without deflation"),
    ],
)
def test_dicom_images_of_no_use(tmp_path, attributes, message):
    with pytest.raises(VolumeError, match=message):
        load_volume(save_dicom(dicom(voxels(), **attributes), tmp_path / "scan.dcm"))


# --- vendors


def fds(array, spacing_um=None):
    """A Topcon .fds by hand, for oct-converter only reads: its header, two or three chunks, the end."""
    bscans, axials, laterals = array.shape

    def chunk(name, content):
        return bytes([len(name)]) + name + struct.pack("<I", len(content)) + content

    scan = struct.pack("<BIIIIBI", 2, laterals, axials, 16, bscans, 0, 0) + array.astype("<u2").tobytes()
    parts = [b"FOCTFDA" + struct.pack("<II", 1, 0), chunk(b"@IMG_SCAN_03", scan)]
    captured = struct.pack("<BBI100s6H", 0, 2, 1, b"", 2024, 1, 2, 3, 4, 5)
    parts.append(chunk(b"@CAPTURE_INFO_02", captured.ljust(200, b"\0")))
    if spacing_um is not None:
        bscan, axial, lateral = spacing_um
        sizes = struct.pack("<3I3d", 0, 0, 0, laterals * lateral * 1e-3, bscans * bscan * 1e-3, axial)
        parts.append(chunk(b"@PARAM_SCAN_04", sizes.ljust(200, b"\0")))
    return b"".join([*parts, b"\0"])


@pytest.fixture
def vendor():
    pytest.importorskip("oct_converter", reason="vendors' files need oct-converter: pip install octn_ros[vendor]")


@pytest.mark.usefixtures("vendor")
def test_topcon(tmp_path):
    (tmp_path / "scan.fds").write_bytes(fds(voxels(), SPACING_UM))
    check(load_volume(tmp_path / "scan.fds"), voxels())
    (tmp_path / "scan.fds").write_bytes(fds(voxels()))
    with pytest.raises(VolumeError, match="--spacing-um"):
        load_volume(tmp_path / "scan.fds")


@pytest.mark.usefixtures("vendor")
def test_zeiss_says_its_size_in_its_name(tmp_path):
    array = voxels(np.uint8, (12, 5, 16))
    name = "P1_Macular Cube 16x12_1-2-2024_3-4-5_OD_sn1_cube_z.img"
    (tmp_path / name).write_bytes(array.transpose(0, 2, 1).tobytes())
    check(load_volume(tmp_path / name, SPACING_UM), array)
    (tmp_path / "scan.img").write_bytes(array.tobytes())
    with pytest.raises(VolumeError, match="512x128"):
        load_volume(tmp_path / "scan.img", SPACING_UM)


@pytest.mark.usefixtures("vendor")
def test_damaged_vendor_files_are_refused(tmp_path):
    (tmp_path / "scan.fds").write_bytes(fds(voxels())[:200])
    with pytest.raises(VolumeError, match="oct-converter cannot read the file"):
        load_volume(tmp_path / "scan.fds", SPACING_UM)


def test_a_missing_vendor_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("octn_ros.volume.vendor.LIBRARY", "no_such_library")
    (tmp_path / "scan.fds").write_bytes(fds(voxels()))
    with pytest.raises(VolumeError, match=r"pip install octn_ros\[vendor\]"):
        load_volume(tmp_path / "scan.fds")


# --- which format


def test_the_content_tells_where_the_suffix_does_not(tmp_path):
    np.save(tmp_path / "scan.npy", voxels())
    (tmp_path / "scan.npy").rename(tmp_path / "scan")
    check(load_volume(tmp_path / "scan", SPACING_UM), voxels())
    (tmp_path / "words.txt").write_text("words " * 100)
    with pytest.raises(VolumeError, match="neither suffix nor content is known"):
        load_volume(tmp_path / "words.txt")
