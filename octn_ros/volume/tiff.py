"""C-scans in multi-page TIFF files, one B-scan a page, through tifffile."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.limits import check_deflated
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader
from octn_ros.volume.volume import Volume

_DEFLATE = (8, 32946)
# Codecs whose expansion is bounded or watched. LZW and JPEG need tifffile's companion imagecodecs.
_CODECS = {1: "none", 5: "LZW", 7: "JPEG", 32773: "PackBits", **dict.fromkeys(_DEFLATE, "deflate")}
_METRES_PER_UNIT = {
    **dict.fromkeys(("m", "meter"), 1.0),
    **dict.fromkeys(("cm", "centimeter"), 1e-2),
    **dict.fromkeys(("mm", "millimeter"), 1e-3),
    **dict.fromkeys(("micron", "microns", "um", "\u00b5m", "\u03bcm", "\\u00B5m", "micrometer"), 1e-6),
    **dict.fromkeys(("nm", "nanometer"), 1e-9),
}
_MAX_DESCRIPTION_CHARS = 2**20


def read_tiff(path: Path, request: ReadRequest) -> RawScan:
    """Read the pages' headers of a TIFF file: [page, row, column] are its axes.

    The spacing is stated by this package's own comment, by ImageJ (`spacing`, resolution and unit) or by OME-XML
    (`PhysicalSizeX`, `Y` and `Z`). The resolution tags alone, which most software fills with a printer's dots per inch,
    state nothing.

    Raises:
        VolumeError: pages differ, use a codec that is not read, are damaged, or claim more than they have or may.
    """
    with tifffile.TiffFile(path) as tif:
        pages = checked_pages(tif, path.stat().st_size, request, content=False)
        header = _own_header(pages[0]) or ScanHeader(spacing_m=_imagej_spacing(tif, len(pages)) or _ome_spacing(tif))
        shape = (len(pages), *pages[0].shape)
        dtype = pages[0].dtype
        assert dtype is not None  # checked_pages has seen to it

    def read_voxels() -> NDArray[Any]:
        array = np.empty(shape, dtype)
        with tifffile.TiffFile(path) as again:
            for index, page in enumerate(checked_pages(again, path.stat().st_size, request)):
                # One thread: several would each keep what they have decoded.
                page.asarray(out=array[index], maxworkers=1)
        return array

    return RawScan(header, shape, dtype, read_voxels)


def checked_pages(
    tif: tifffile.TiffFile, size: int, request: ReadRequest, *, content: bool = True
) -> list[tifffile.TiffPage]:
    """Return the pages of a file, of which there is at least one, all alike and none claiming more than it may.

    Args:
        tif: the open file.
        size: its bytes.
        request: what may be read.
        content: whether what large compressed segments expand to is looked at, for which they are read.

    Raises:
        VolumeError: as `read_tiff`.
    """
    pages: list[tifffile.TiffPage] = []
    seen: set[int] = set()
    for index, page in enumerate(tif.pages):
        if not isinstance(page, tifffile.TiffPage):
            raise VolumeError(f"page {index} has no header of its own; the file is damaged")
        if page.offset in seen:
            raise VolumeError(f"the chain of pages runs in a circle after page {index - 1}; the file is damaged")
        seen.add(page.offset)
        _check_page(page, index, size)
        if pages and (page.shape, page.dtype) != (pages[0].shape, pages[0].dtype):
            raise VolumeError(
                f"page {index}: expected {pages[0].shape} of {pages[0].dtype} like the pages before, "
                f"got {page.shape} of {page.dtype}"
            )
        pages.append(page)
    if not pages:
        raise VolumeError("expected a TIFF file with a page for each B-scan, got no page")
    _check_end(tif, pages[-1])
    first = pages[0]
    assert first.dtype is not None  # _check_page has seen to it
    request.limit.check_array((len(pages), *first.shape), first.dtype, size, compressed=first.compression != 1)
    for page in pages:
        if content and page.compression in _DEFLATE:
            _check_segments(tif, page)
    return pages


def write_tiff(path: Path, volume: Volume) -> None:
    """Write a C-scan as pages of 8 or 16 bits or single floats, with its header as JSON in the first description.

    Raises:
        OSError: the file cannot be written.
    """
    _, axial, lateral = volume.geometry.spacing_m
    tifffile.imwrite(
        path,
        volume.array,
        photometric="minisblack",
        description=ScanHeader.of(volume).to_json(),
        metadata=None,
        resolution=(1e-2 / lateral, 1e-2 / axial),
        resolutionunit="CENTIMETER",
    )


def _check_page(page: tifffile.TiffPage, index: int, size: int) -> None:
    if page.samplesperpixel != 1 or len(page.shape) != 2:
        raise VolumeError(f"page {index}: expected a grey image, got {page.samplesperpixel} colours in {page.shape}")
    if page.compression not in _CODECS:
        names = ", ".join(sorted(set(_CODECS.values())))
        raise VolumeError(
            f"page {index}: expected a compression of {names}, got {page.compression!r:.40}; save it anew"
        )
    if page.dtype is None or page.dtype.kind not in "uif":
        raise VolumeError(
            f"page {index}: expected integers or floats of 8, 16, 32 or 64 bits, got {page.bitspersample}"
        )
    offsets, counts = page.dataoffsets, page.databytecounts
    if (
        not offsets
        or len(offsets) != len(counts)
        or any(
            count <= 0 or offset <= 0 or offset + count > size for offset, count in zip(offsets, counts, strict=True)
        )
    ):
        raise VolumeError(f"page {index}: its pixels lie outside the file; it is damaged or truncated")
    if page.compression == 1 and sum(counts) < page.nbytes:
        raise VolumeError(f"page {index}: expected {page.nbytes:,} bytes of pixels, the file has {sum(counts):,}")


def _check_end(tif: tifffile.TiffFile, last: tifffile.TiffPage) -> None:
    """Refuse a chain of pages that ends because the next one lies outside the file: B-scans would be missing."""
    form, file = tif.tiff, tif.filehandle
    file.seek(last.offset)
    (tags,) = struct.unpack(form.tagnoformat, file.read(form.tagnosize))
    file.seek(last.offset + form.tagnosize + tags * form.tagsize)
    following = file.read(form.offsetsize)
    if following.strip(b"\0") or len(following) < form.offsetsize:
        raise VolumeError("the chain of pages leads outside the file; it is damaged or truncated")


def _check_segments(tif: tifffile.TiffFile, page: tifffile.TiffPage) -> None:
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        tif.filehandle.seek(offset)
        check_deflated(tif.filehandle.read(count), page.nbytes)


def _own_header(page: tifffile.TiffPage) -> ScanHeader | None:
    description = page.description
    return ScanHeader.from_json(description) if len(description) <= _MAX_DESCRIPTION_CHARS else None


def _imagej_spacing(tif: tifffile.TiffFile, count: int) -> tuple[float, float, float] | None:
    stated = tif.imagej_metadata if tif.is_imagej else None
    if not stated:
        return None
    if int(stated.get("images", 1)) > count:
        raise VolumeError(f"ImageJ states {stated['images']} images, the file has {count} pages; save it as BigTIFF")
    metres = _METRES_PER_UNIT.get(str(stated.get("unit", "")).strip())
    page = tif.pages[0]
    resolutions = [page.tags.get(name) for name in ("YResolution", "XResolution")]  # type: ignore[union-attr]
    if metres is None or "spacing" not in stated or None in resolutions:
        return None
    row, column = (tag.value[1] / tag.value[0] for tag in resolutions)  # type: ignore[union-attr]
    return abs(float(stated["spacing"])) * metres, row * metres, column * metres


def _ome_spacing(tif: tifffile.TiffFile) -> tuple[float, float, float] | None:
    stated = tif.ome_metadata if tif.is_ome else None
    pixels = re.search(r"<Pixels\b[^>]*>", stated[:_MAX_DESCRIPTION_CHARS]) if stated else None
    if pixels is None:
        return None
    attributes = dict(re.findall(r'PhysicalSize(\w+)="([^"]*)"', pixels[0]))
    spacing = []
    for axis in "ZYX":
        metres = _METRES_PER_UNIT.get(attributes.get(f"{axis}Unit", "um"))  # the standard's default is micrometres
        if axis not in attributes or metres is None:
            return None
        spacing.append(float(attributes[axis]) * metres)
    return spacing[0], spacing[1], spacing[2]
