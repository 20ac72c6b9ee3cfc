"""Folders of numbered B-scan images, through Pillow and tifffile."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from octn_ros.errors import VolumeError
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader
from octn_ros.volume.tiff import checked_pages

_TIFF_SUFFIXES = (".tif", ".tiff")
IMAGE_SUFFIXES = (".png", ".bmp", ".jpg", ".jpeg", ".pgm", *_TIFF_SUFFIXES)
# Types of Pillow's modes of grey images; "I" is what it makes of 16 bits in .pgm, though it has room for 32.
_GREY_TYPES = {"L": np.uint8, "I": np.uint16, "I;16": np.uint16, "I;16B": np.uint16, "I;16L": np.uint16}
_COLOUR_MODES = ("RGB", "RGBA", "P")
_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)$")  # the last number in a name counts


def read_image_folder(path: Path, request: ReadRequest) -> RawScan:
    """Read a folder whose images are B-scans: [image, row, column] are the axes of the scan.

    Images are sorted by the last number in their names, as numbers; they may begin with any. Files of other types are
    not looked at. Colour images are taken if they are grey.

    Raises:
        VolumeError: names the file at which the numbering has a gap, names differ in more than their number, the size
            or type changes, or that is damaged.
    """
    files = numbered_images(path)
    shape, dtype = _probe(files[0])
    stored = sum(file.stat().st_size for file in files)
    request.limit.check_array((len(files), *shape), dtype, stored, compressed=True)

    def read_voxels() -> NDArray[Any]:
        array = np.empty((len(files), *shape), dtype)
        for index, file in enumerate(files):
            probed = _probe(file)
            if probed != (shape, dtype):
                raise VolumeError(
                    f"{file.name}: expected an image of {shape} and {dtype} like {files[0].name}, "
                    f"got {probed[0]} and {probed[1]}"
                )
            array[index] = _naming(file, lambda file=file: _pixels(file, request))
        return array

    return RawScan(ScanHeader(), (len(files), *shape), dtype, read_voxels)


def numbered_images(path: Path) -> list[Path]:
    """Return the images of a folder in the order of their numbers.

    Raises:
        VolumeError: there are fewer than two, one has no number or another name, or a number is missing or repeated.
    """
    named = (p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    images = [p for p in named if p.is_file()]
    numbered: dict[int, Path] = {}
    names: tuple[str, str, str] | None = None
    for image in sorted(images):
        match = _NUMBERED.fullmatch(image.stem)
        if match is None:
            raise VolumeError(f"{image.name}: expected a number in the name of every B-scan image")
        if len(match[2]) > 18:
            raise VolumeError(f"{image.name}: expected the number of a B-scan, got one of {len(match[2])} digits")
        around = (match[1], match[3], image.suffix)
        if names is not None and around != names:
            raise VolumeError(
                f"{image.name}: expected a name like {names[0]}<number>{names[1]}{names[2]}, as the images before it; "
                "move other images elsewhere"
            )
        names = around
        number = int(match[2])
        if number in numbered:
            raise VolumeError(f"{image.name}: B-scan {number} is there already, in {numbered[number].name}")
        numbered[number] = image
    if len(numbered) < 2:
        raise VolumeError(f"expected a folder of numbered images ({', '.join(IMAGE_SUFFIXES)}), got {len(numbered)}")
    order = sorted(numbered)
    for before, after in itertools.pairwise(order):
        if after != before + 1:
            raise VolumeError(
                f"{numbered[after].name}: a gap in the numbering, expected B-scan {before + 1} "
                f"after {numbered[before].name}"
            )
    return [numbered[number] for number in order]


def _probe(file: Path) -> tuple[tuple[int, int], np.dtype[Any]]:
    """Return height, width and type of an image without decoding its pixels."""
    return _naming(file, lambda: _probe_tiff(file) if file.suffix.lower() in _TIFF_SUFFIXES else _probe_other(file))


def _probe_tiff(file: Path) -> tuple[tuple[int, int], np.dtype[Any]]:
    with tifffile.TiffFile(file) as tif:
        page = _single_page(tif, file, ReadRequest())
        height, width = page.shape
        assert page.dtype is not None  # checked_pages has seen to it
        return (height, width), page.dtype


def _probe_other(file: Path) -> tuple[tuple[int, int], np.dtype[Any]]:
    with Image.open(file) as image:
        dtype = np.uint8 if image.mode in _COLOUR_MODES else _GREY_TYPES.get(image.mode)
        if dtype is None:
            raise VolumeError(f"expected a grey image of 8 or 16 bits, got the mode {image.mode}")
        return (image.height, image.width), np.dtype(dtype)


def _pixels(file: Path, request: ReadRequest) -> NDArray[Any]:
    if file.suffix.lower() in _TIFF_SUFFIXES:
        with tifffile.TiffFile(file) as tif:
            return _single_page(tif, file, request).asarray(maxworkers=1)
    with Image.open(file) as image:
        if image.mode not in _COLOUR_MODES:
            return np.asarray(image).astype(_GREY_TYPES[image.mode], copy=False)
        colours = np.asarray(image.convert("RGB"))
    if (colours[..., 1:] != colours[..., :1]).any():
        raise VolumeError("expected a grey image, its red, green and blue differ")
    return colours[..., 0]


def _single_page(tif: tifffile.TiffFile, file: Path, request: ReadRequest) -> tifffile.TiffPage:
    pages = checked_pages(tif, file.stat().st_size, request)
    if len(pages) != 1:
        raise VolumeError(f"expected one image, got {len(pages)} pages")
    return pages[0]


def _naming(file: Path, read: Any) -> Any:
    try:
        return read()
    except VolumeError as error:
        raise VolumeError(f"{file.name}: {error}") from error
    except MemoryError:
        raise
    except Exception as error:  # decoders raise anything at all when a file is damaged
        raise VolumeError(f"{file.name}: the image is damaged or of another format: {error}") from error
