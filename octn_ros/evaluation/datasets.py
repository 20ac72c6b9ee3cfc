"""The paper's four data sets, recognised by their folders and files: which scan is which, and what its spacing is."""

from __future__ import annotations

import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from numpy.lib import format as npy_format

from octn_ros.errors import VolumeError
from octn_ros.volume import Volume, load_volume
from octn_ros.volume.image_folder import numbered_images
from octn_ros.volume.loading import NO_SPACING

SpacingUm = tuple[float, float, float]
_EYE = re.compile(r"(AMD|DME|NORMAL) *\(?\d+\)?", re.IGNORECASE)
_GDP_ARRAYS = ("bscans", "oct_bscans")


@dataclass(frozen=True)
class DataSet:
    """A published set of C-scans; docs/datasets.md says where to get it.

    Attributes:
        name: as in the paper.
        spacing: one sentence on the spacing: where it is documented, or that it is not.
    """

    name: str
    spacing: str


TISSUE_OCT = DataSet(
    "TissueOCT", "28 x 14.59 x 14 um (bscan, axial, lateral) as the paper documents it, where files state none"
)
SRINIVASAN = DataSet("Srinivasan", "another for every eye and stands in no file; it has to be given")
HARVARD_GDP = DataSet(
    "Harvard GDP",
    "30 x 10 x 30 um (bscan, axial, lateral): the 6 x 2 x 6 mm of the Cirrus 200 x 200 cube over 200 voxels each, "
    "which the set itself does not state",
)
NOOR = DataSet("Noor", "another for every eye and stands in no file; it has to be given")
_TISSUE_OCT_SHAPE, _TISSUE_OCT_UM = (256, 512, 512), (28.0, 14.59, 14.0)
_HARVARD_SHAPE, _HARVARD_UM = (200, 200, 200), (30.0, 10.0, 30.0)


@dataclass(frozen=True)
class SetScan:
    """A C-scan of a folder, and what is known of it beyond its file; immutable.

    Attributes:
        path: file or folder of images.
        name: in tables.
        data_set: which it belongs to, None if it is none of the four.
        spacing_um: what the set documents where the file states nothing, (bscan, axial, lateral).
        variable: array of the file that holds the scan.
        first_image: images of the folder before this one are no B-scans.
    """

    path: Path
    name: str
    data_set: DataSet | None = None
    spacing_um: SpacingUm | None = None
    variable: str | None = None
    first_image: int = 0

    def load(self, spacing_um: SpacingUm | None = None) -> Volume:
        """Read the scan.

        Args:
            spacing_um: wins over what file and set state, (bscan, axial, lateral).

        Raises:
            VolumeError: the scan cannot be read, or nobody states its spacing.
        """
        spacing_um = spacing_um or self.spacing_um
        try:
            if self.first_image:
                return _without_first_images(self.path, self.first_image, spacing_um)
            return load_volume(self.path, spacing_um, variable=self.variable)
        except VolumeError as error:
            if self.data_set is not None and str(error).endswith(NO_SPACING):
                raise VolumeError(
                    f"{self.path}: the spacing of {self.data_set.name} is {self.data_set.spacing}, as --spacing-um "
                    "BSCAN AXIAL LATERAL"
                ) from error
            raise


def set_scan(path: Path, folder: Path) -> SetScan | None:
    """Tell what one of the scans that `scan_files` found in a folder is; None if it is none after all.

    By its layout: TissueOCT is a NIfTI file of 256 x 512 x 512 voxels under a name with TissueOCT in it; Srinivasan an
    eye's `TIFFs/8bitTIFFs`; Harvard GDP an .npz file with the array `bscans` or `oct_bscans` (one with a thickness map
    alone is no scan); Noor a folder `AMD (1)` within `AMD`, and likewise for DME and NORMAL. Reads headers, no voxel.
    """
    relative = str(path.relative_to(folder))
    if path.is_dir():
        return _of_images(path) or SetScan(path, relative)
    if path.suffix.lower() == ".npz":
        return _of_arrays(path, relative)
    if path.name.lower().endswith((".nii", ".nii.gz")) and "tissueoct" in str(path.resolve()).lower():
        return _of_tissue_oct(path, relative)
    return SetScan(path, relative)


def _of_images(path: Path) -> SetScan | None:
    eye, parent = path.parent.parent, path.parent
    if path.name.lower() == "8bittiffs" and parent.name.lower() == "tiffs" and _EYE.fullmatch(eye.name):
        return SetScan(path, f"Srinivasan {eye.name}", SRINIVASAN)
    if parent.name.upper() in ("AMD", "DME", "NORMAL") and _EYE.fullmatch(path.name):
        # The first image of the eyes with DME is no B-scan.
        return SetScan(path, f"Noor {path.name}", NOOR, first_image=1 if parent.name.upper() == "DME" else 0)
    return None


def _of_arrays(path: Path, relative: str) -> SetScan | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {Path(name).stem for name in archive.namelist()}
            variable = next((name for name in _GDP_ARRAYS if name in names), None)
            if variable is None:
                return None if "rnflt" in names else SetScan(path, relative)
            with archive.open(f"{variable}.npy") as file:
                read = {(1, 0): npy_format.read_array_header_1_0}.get(
                    npy_format.read_magic(file), npy_format.read_array_header_2_0
                )
                shape = read(file)[0]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):  # whoever loads it hears what is wrong
        return SetScan(path, relative)
    known = _HARVARD_UM if shape == _HARVARD_SHAPE else None
    return SetScan(path, f"Harvard GDP {path.stem}", HARVARD_GDP, known, variable)


def _of_tissue_oct(path: Path, relative: str) -> SetScan:
    import nibabel  # here, since few scans need it

    try:
        header = nibabel.load(path).header
    except (OSError, nibabel.filebasedimages.ImageFileError):  # whoever loads it hears what is wrong
        return SetScan(path, relative)
    assert isinstance(header, nibabel.Nifti1Header)
    if header.get_data_shape() != _TISSUE_OCT_SHAPE:
        return SetScan(path, relative)
    stated = header.get_xyzt_units()[0] != "unknown"
    return SetScan(path, f"TissueOCT {relative}", TISSUE_OCT, None if stated else _TISSUE_OCT_UM)


def _without_first_images(path: Path, first: int, spacing_um: SpacingUm | None) -> Volume:
    """Read a folder of numbered images without the first ones, through a folder of links to the others."""
    with tempfile.TemporaryDirectory() as links:
        for image in numbered_images(path)[first:]:
            (Path(links) / image.name).symlink_to(image.resolve())
        try:
            return load_volume(links, spacing_um)
        except VolumeError as error:
            raise VolumeError(str(error).replace(links, str(path))) from error
