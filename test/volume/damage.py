"""Read damaged and hostile files, in a process that may take 2 GB of memory and 5 s of processor time for each.

`python damage.py FOLDER FIRST COUNT STEP` makes and reads the files FIRST, FIRST + STEP, ... and prints a line of JSON
before and after each, so that whoever started it knows which file it was if the process does not come back.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import resource
import shutil
import signal
import struct
import sys
import time
import zipfile
import zlib
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pydicom
import scipy.io
import tifffile
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset

from octn_ros.errors import OctnError
from octn_ros.volume import Volume, load_volume, save_volume

MEMORY_BYTES = 2 * 10**9
SECONDS = 5
SPACING_UM = (28.0, 14.0, 14.0)
ARRAY = np.random.default_rng(0).integers(0, 4000, (5, 24, 20)).astype(np.uint16)
VOLUME = Volume.from_array(ARRAY, (28e-6, 14e-6, 14e-6), intensity_scale="log")
# A vendor's file takes a process of its own, hence fewer of them.
VENDOR_EVERY = 40


def sound_files(folder: Path) -> list[tuple[Path, ...]]:
    """Write one sound file in every format; a folder of images counts as its files."""
    for name in ("own.nii", "own.nii.gz", "own.npz", "own.tif"):
        save_volume(folder / name, VOLUME)
    nibabel.save(nibabel.Nifti2Image(ARRAY.astype(np.int16), np.eye(4)), folder / "second.nii")
    np.save(folder / "plain.npy", ARRAY)
    np.savez_compressed(folder / "packed.npz", volume=ARRAY, spacing_um=np.array(SPACING_UM))
    tifffile.imwrite(folder / "deflate.tif", ARRAY, photometric="minisblack", compression="zlib", predictor=2)
    tifffile.imwrite(folder / "imagej.tif", ARRAY, imagej=True, metadata={"axes": "ZYX", "spacing": 28, "unit": "um"})
    tifffile.imwrite(folder / "ome.tif", ARRAY, ome=True, metadata={"axes": "ZYX", "PhysicalSizeZ": 28}, tile=(16, 16))
    scipy.io.savemat(folder / "five.mat", {"scan": ARRAY, "spacing_um": np.array(SPACING_UM)})
    scipy.io.savemat(folder / "packed.mat", {"scan": ARRAY.astype(float), "s": {"a": [1]}}, do_compression=True)
    scipy.io.savemat(folder / "four.mat", {"scan": ARRAY[0].astype(float)}, format="4")
    for name, options in (("plain", {}), ("packed", {"chunks": (2, 8, 8), "compression": "gzip", "shuffle": True})):
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file.create_dataset("scan", data=ARRAY, **options).attrs["MATLAB_class"] = np.bytes_("uint16")
            file["spacing_um"], file["group/more"] = np.array(SPACING_UM), ARRAY
    with h5py.File(folder / "seven.mat", "w", userblock_size=512) as file:
        file["scan"] = ARRAY
    pydicom.dcmwrite(folder / "plain.dcm", _dicom(), enforce_file_format=True)
    packed = _dicom()
    packed.compress(pydicom.uid.RLELossless)
    pydicom.dcmwrite(folder / "packed.dcm", packed, enforce_file_format=True)
    for suffix, array in (("png", ARRAY), ("jpg", ARRAY >> 4), ("tif", ARRAY), ("bmp", ARRAY >> 4), ("pgm", ARRAY)):
        images = folder / suffix
        images.mkdir()
        for index, bscan in enumerate(array):
            bscan = bscan if suffix in ("png", "tif", "pgm") else bscan.astype(np.uint8)
            Image.fromarray(bscan).save(images / f"scan_{index}.{suffix}")
    return [(path,) if path.is_file() else tuple(sorted(path.iterdir())) for path in sorted(folder.iterdir())]


def vendor_files(folder: Path) -> list[tuple[Path, ...]]:
    """Write files that look like vendors' to their readers, as far as that goes."""
    chunk = b"\x0c@IMG_SCAN_03" + struct.pack("<I", 22 + ARRAY.nbytes)
    scan = struct.pack("<BIIIIBI", 2, 20, 24, 16, 5, 0, 0) + ARRAY.tobytes()
    captured = b"\x0d@CAPTURE_INFO" + struct.pack("<IB6H", 13, 0, 2024, 1, 2, 3, 4, 5)
    (folder / "scan.fds").write_bytes(b"FOCTFDA" + bytes(8) + chunk + scan + captured + b"\0")
    (folder / "scan_20x5.img").write_bytes(ARRAY.astype(np.uint8).tobytes())
    # Heidelberg's directory of which every part says that the one before it is itself.
    directory = b"MDbMDir".ljust(12, b"\0") + struct.pack("<I20xIIII", 100, 4, 36, 36, 0)
    (folder / "loop.e2e").write_bytes(b"CMDb".ljust(36, b"\0") + directory + bytes(2000))
    fields = b"".join(
        struct.pack("<I", len(key)) + key + struct.pack("<I", len(value)) + value
        for key, value in ((b"FRAMECOUNT", struct.pack("<I", 2**31 - 1)), (b"LINECOUNT", struct.pack("<I", 2**31 - 1)))
    )
    (folder / "scan.oct").write_bytes(struct.pack("<IH", 0xA5, 1) + fields * 10)
    return [(path,) for path in sorted(folder.iterdir())]


def _dicom() -> Dataset:
    data_set = Dataset()
    data_set.file_meta = FileMetaDataset()
    data_set.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data_set.file_meta.MediaStorageSOPClassUID = data_set.SOPClassUID = pydicom.uid.OphthalmicTomographyImageStorage
    data_set.file_meta.MediaStorageSOPInstanceUID = data_set.SOPInstanceUID = "1.2.3"
    data_set.NumberOfFrames, data_set.Rows, data_set.Columns = ARRAY.shape
    data_set.SamplesPerPixel, data_set.PhotometricInterpretation, data_set.PixelRepresentation = 1, "MONOCHROME2", 0
    data_set.BitsAllocated = data_set.BitsStored = 16
    data_set.HighBit = 15
    measures, shared = Dataset(), Dataset()
    measures.PixelSpacing, measures.SpacingBetweenSlices = [0.014, 0.014], 0.028
    shared.PixelMeasuresSequence = [measures]
    data_set.SharedFunctionalGroupsSequence = [shared]
    data_set.PixelData = ARRAY.tobytes()
    return data_set


# --- damage that any file can suffer: each takes the bytes and a random generator and returns the bytes


def truncated(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(len(content))]


def flipped(content: bytes, chance: random.Random) -> bytes:
    spoilt = bytearray(content)
    reach = len(spoilt) if chance.random() < 0.5 else min(len(spoilt), 600)
    for _ in range(chance.choice((1, 1, 2, 8, 64))):
        spoilt[chance.randrange(reach)] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


def hostile_number(content: bytes, chance: random.Random) -> bytes:
    spoilt = bytearray(content)
    number = chance.choice((0, 1, 2**15 - 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1))
    width = chance.choice([n for n in (2, 4, 8) if number < 256**n])
    place = chance.randrange(min(len(spoilt), chance.choice((64, 400, 4000, 10**9))))
    spoilt[place : place + width] = number.to_bytes(width, chance.choice(("little", "big")))
    return bytes(spoilt[: len(content)])


def wiped(content: bytes, chance: random.Random) -> bytes:
    start = chance.randrange(len(content))
    count = chance.randrange(1, 1 + len(content) // 2)
    filling = chance.choice((bytes(count), b"\xff" * count, chance.randbytes(count)))
    return (content[:start] + filling + content[start + count :])[: len(content)]


def repeated(content: bytes, chance: random.Random) -> bytes:
    start, stop = sorted(chance.randrange(len(content) + 1) for _ in range(2))
    return content[:stop] + content[start:]


def noise(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(16)] + chance.randbytes(chance.randrange(1, len(content)))


DAMAGES = (truncated, flipped, flipped, hostile_number, hostile_number, wiped, repeated, noise)


# --- files that were made to harm


def _nifti(dim: tuple[int, ...], datatype: int = 4, offset: float = 352.0, tail: bytes = bytes(100)) -> bytes:
    header = bytearray(bytes(nibabel.Nifti1Header().binaryblock) + bytes(4))
    struct.pack_into("<8h", header, 40, 3, *dim, 1, 1, 1, 1)
    struct.pack_into("<hh", header, 70, datatype, 16)
    struct.pack_into("<f", header, 108, offset)
    header[344:348] = b"n+1\0"
    return bytes(header) + tail


def _nifti2(dim: tuple[int, ...]) -> bytes:
    image = nibabel.Nifti2Header()
    image["dim"][1:4], image["dim"][0], image["magic"] = dim, 3, b"n+2\0\r\n\x1a\n"
    image["vox_offset"], image["datatype"], image["bitpix"] = 544, 2, 8
    return bytes(image.binaryblock) + bytes(104)


def _npy(shape: str, descr: str = "'<u2'", tail: bytes = bytes(100)) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(header)) + header + tail


def _zip(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def _tiff_loop(pages: int) -> bytes:
    """A chain of pages of which the last points to the first, or to one in the middle."""
    tags = [
        (256, 4, 1, 8),
        (257, 4, 1, 8),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, 1, 8),
        (279, 4, 1, 64),
    ]
    size = 2 + 12 * len(tags) + 4
    content = b"II*\0" + struct.pack("<I", 72) + bytes(64)
    for index in range(pages):
        following = 72 + size * (index + 1) if index + 1 < pages else 72 + size * (pages // 2)
        entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
        content += struct.pack("<H", len(tags)) + entries + struct.pack("<I", following)
    return content


def _tiff_page(width: int, height: int, compression: int = 1, strip: bytes = bytes(64)) -> bytes:
    tags = [
        *((256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, compression), (262, 3, 1, 1)),
        *((273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, len(strip))),
    ]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    start = 8 + len(strip)
    return b"II*\0" + struct.pack("<I", start) + strip + struct.pack("<H", len(tags)) + entries + bytes(4)


def _png(width: int, height: int, pixels: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def _mat5(dims: tuple[int, ...], claimed: int) -> bytes:
    def element(kind: int, content: bytes, size: int | None = None) -> bytes:
        return struct.pack("<II", kind, len(content) if size is None else size) + content + bytes(-len(content) % 8)

    array = element(6, struct.pack("<II", 11, 0)) + element(5, struct.pack(f"<{len(dims)}i", *dims))
    array += element(1, b"scan") + element(4, bytes(64), claimed)
    start = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    return start + element(14, array)


def _mat5_nested(depth: int) -> bytes:
    content = b""
    for _ in range(depth):
        head = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<HH4s", 1, 1, b"c")
        content = struct.pack("<II", 14, len(head) + len(content)) + head + content
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM") + content


def _hdf5(**options: object) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w") as scan:
        scan.create_dataset("scan", **options)
    return file.getvalue()


def _hdf5_bomb() -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w") as scan:
        dataset = scan.create_dataset("scan", (2, 8, 8), "u1", chunks=(2, 8, 8), compression="gzip")
        dataset.id.write_direct_chunk((0, 0, 0), b"\x78\xda" + _zeros_deflated())
    return file.getvalue()


def _dicom_claiming(**attributes: object) -> bytes:
    data_set = _dicom()
    for name, value in attributes.items():
        setattr(data_set, name, value)
    file = io.BytesIO()
    pydicom.dcmwrite(file, data_set, enforce_file_format=True)
    return file.getvalue()


def _dicom_deflated() -> bytes:
    """A deflated data set of four gigabytes of nothing."""
    data_set = _dicom()
    data_set.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
    file = io.BytesIO()
    pydicom.dcmwrite(file, data_set, enforce_file_format=True)
    return file.getvalue()[:330] + _zeros_deflated()


def _zeros_deflated() -> bytes:
    """Return raw deflate blocks, without an end, of four gigabytes of nothing."""
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    portion = stream.compress(bytes(2**24)) + stream.flush(zlib.Z_FULL_FLUSH)  # a block that stands for itself
    return portion * 256


def _gzip_bomb(start: bytes) -> bytes:
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    blocks = stream.compress(start) + stream.flush(zlib.Z_FULL_FLUSH) + _zeros_deflated()
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + blocks


def hostile_files() -> dict[str, bytes]:
    """Return files by name that claim too much, expand without end, or lead a reader round in circles."""
    deflated = b"\x78\xda" + _zeros_deflated()
    huge = 32767
    extension = struct.pack("<ii", 2**31 - 16, 6) + bytes(64)
    with_extension = bytearray(_nifti((4, 4, 4), offset=1000.0, tail=extension + bytes(2000)))
    with_extension[348] = 1
    deep = json.dumps({"octn_volume": 1}).replace("1", "[" * 100_000 + "]" * 100_000).encode()
    own = b'{"octn_volume": {"spacing_m": [1e999, -1, "x"], "stamp_ns": -1}}'
    return {
        "dims.nii": _nifti((huge, huge, huge)),
        "negative.nii": _nifti((-1, 4, 4)),
        "zero.nii": _nifti((0, 4, 4)),
        "offset.nii": _nifti((4, 4, 4), offset=3e38),
        "extension.nii": bytes(with_extension),
        "complex.nii": _nifti((4, 4, 4), datatype=32),
        "dims2.nii": _nifti2((2**31, 2**31, 2**31)),
        "dims3.nii": _nifti2((2**62, 2**62, 4)),
        "dims.nii.gz": gzip.compress(_nifti((huge, huge, huge))),
        "bomb.nii.gz": _gzip_bomb(_nifti((huge, huge, 4), tail=b"")),
        "bomb2.nii.gz": _gzip_bomb(_nifti((500, 500, 500), tail=b"")),
        "bomb3.nii.gz": _gzip_bomb(_nifti((4, 4, 4), offset=2e9, tail=b"")),
        "shape.npy": _npy("(2147483648, 2147483648, 2147483648)"),
        "shape2.npy": _npy("(9223372036854775807, 3, 3)"),
        "shape3.npy": _npy("(-4, 4, 4)"),
        "nested.npy": _npy("(" * 5000 + ")" * 5000),
        "object.npy": _npy("(4, 4, 4)", "'|O'", b"\x80\x04cos\nsystem\n(S'false'\ntR."),
        "wide.npy": _npy("(4, 4, 4)", "'|V2147483647'"),
        "long.npy": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{",
        "bomb.npz": _zip({"volume.npy": _npy("(16, 16384, 16384)", "'|u1'", bytes(2**20))}),
        "liar.npz": _zip({"volume.npy": _npy("(64, 8192, 8192)", "'|u1'", b"")}),
        "many.npz": _zip({f"a{index}.npy": _npy("(2, 2, 2)") for index in range(3000)}),
        "expanding.npz": _zip_with_stream("volume.npy", _npy("(2, 2, 2)", tail=b""), deflated),
        "loop1.tif": _tiff_loop(1),
        "loop2.tif": _tiff_loop(2),
        "loop500.tif": _tiff_loop(500),
        "wide.tif": _tiff_page(2**31 - 1, 2**31 - 1),
        "bomb.tif": _tiff_page(64, 64, 8, deflated),
        "claim.tif": _tiff_page(2**15, 2**16, 8, zlib.compress(bytes(1000))),
        "lzma.tif": _tiff_page(64, 64, 34925),
        "json.tif": _tiff_described(deep),
        "own.tif": _tiff_described(own),
        "dims.mat": _mat5((2**31 - 1, 2**31 - 1, 4), 64),
        "claim.mat": _mat5((1024, 1024, 1024), 2**32 - 8),
        "nested.mat": _mat5_nested(20_000),
        "dims.h5": _hdf5(shape=(2**31, 2**31, 2**31), dtype="u2", chunks=(1, 64, 64)),
        "late.h5": _hdf5(shape=(40, 4096, 4096), dtype="u2"),
        "chunk.h5": _hdf5(shape=(4, 2**15, 2**15), dtype="u2", chunks=(1, 2**15, 2**15), compression="gzip"),
        "bomb.h5": _hdf5_bomb(),
        "frames.dcm": _dicom_claiming(NumberOfFrames=2**31 - 1),
        "rows.dcm": _dicom_claiming(Rows=65535, Columns=65535),
        "bits.dcm": _dicom_claiming(BitsStored=60000),
        "spacing.dcm": _dicom_claiming(SharedFunctionalGroupsSequence=[], PixelSpacing=[1e300, 0]),
        "deflated.dcm": _dicom_deflated(),
        "claims.png": _png(65_000, 65_000, zlib.compress(bytes(1000))),
        "bomb.png": _png(20, 24, deflated),
        "text.fds": b"FOCTFDA" + bytes(8) + b"\xff" * 3000,
    }


def _zip_with_stream(name: str, start: bytes, deflated: bytes) -> bytes:
    """An archive whose member says it is small and expands to gigabytes."""
    body = bytearray(_zip({name: start}))
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = stream.compress(start) + stream.flush(zlib.Z_SYNC_FLUSH)
    content = first + deflated[2:]
    crc, sizes = struct.pack("<I", 0), struct.pack("<II", len(content), len(start))
    local = b"PK\x03\x04" + struct.pack("<HHHHH", 20, 0, 8, 0, 0) + crc + sizes + struct.pack("<HH", len(name), 0)
    central = b"PK\x01\x02" + struct.pack("<HHHHHH", 20, 20, 0, 8, 0, 0) + crc + sizes
    central += struct.pack("<HHHHHII", len(name), 0, 0, 0, 0, 0, 0) + name.encode()
    body = local + name.encode() + content
    return body + central + b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(body), 0)


def _tiff_described(description: bytes) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, ARRAY, photometric="minisblack", description=description, metadata=None)
    return file.getvalue()


# --- the run


def place(folder: Path, files: tuple[Path, ...], spoil: object, chance: random.Random) -> tuple[Path, str]:
    """Write a damaged copy of a sound file, or of a folder with one damaged image; return what to read."""
    chosen = chance.choice(files)
    content = spoil(chosen.read_bytes(), chance) or b"\0"  # type: ignore[operator]
    if len(files) > 1:
        target = folder / "images"
        shutil.copytree(chosen.parent, target)
        (target / chosen.name).write_bytes(content)
        return target, f"{chosen.parent.name}/{chosen.name}"
    name = chosen.name
    if chance.random() < 0.05:  # a file that is not what its name says
        name = f"other{chance.choice(('.nii', '.nii.gz', '.npy', '.npz', '.tif', '.mat', '.h5', '.dcm', ''))}"
    (folder / name).write_bytes(content)
    return folder / name, f"{chosen.name} as {name}"


def place_hostile(folder: Path, name: str, content: bytes) -> Path:
    """Write a hostile file; an image comes with sound ones around it."""
    if not name.endswith(".png"):
        (folder / name).write_bytes(content)
        return folder / name
    for index in range(3):
        Image.fromarray(ARRAY[index].astype(np.uint8)).save(folder / f"scan_{index}.png")
    (folder / f"scan_{hash(name) % 3}.png").write_bytes(content)
    return folder


def read(path: Path, spacing_um: tuple[float, float, float] | None) -> dict[str, object]:
    """Read one file within its limits and say how that went."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # nobody handles its signal: it ends the process
    start, clock = _processor_s(), time.monotonic()
    refusal = None
    try:
        load_volume(path, spacing_um)
    except OctnError as error:
        refusal = str(error)
    signal.setitimer(signal.ITIMER_PROF, 0)
    assert refusal is None or refusal.startswith(f"{path}: "), refusal
    return {
        "outcome": "read" if refusal is None else "refused",
        "cpu_s": _processor_s() - start,
        "wall_s": time.monotonic() - clock,
        "peak_bytes": max(_own_peak_bytes(), 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss),
    }


def _own_peak_bytes() -> int:
    """Peak memory since this program began; `ru_maxrss` would begin with that of whoever started it."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))


def _processor_s() -> float:
    """Processor time of this process and of those it has started and waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def main(folder: Path, first: int, count: int, step: int) -> None:
    """Make, damage and read the files."""
    for part in ("sound", "vendor"):
        (folder / part).mkdir()
    sound, vendor, hostile = (
        sound_files(folder / "sound"),
        vendor_files(folder / "vendor"),
        list(hostile_files().items()),
    )
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for index in range(first, count, step):
        chance = random.Random(index)
        place_in = folder / str(index)
        place_in.mkdir()
        if index < len(hostile):
            name = hostile[index][0]
            path, damage = place_hostile(place_in, *hostile[index]), "hostile"
        else:
            spoil = chance.choice(DAMAGES)
            files = chance.choice(vendor if index % VENDOR_EVERY == 0 else sound)
            path, name = place(place_in, files, spoil, chance)
            damage = spoil.__name__
        print(json.dumps({"index": index, "name": name, "damage": damage}), flush=True)
        print(json.dumps(read(path, SPACING_UM if chance.random() < 0.8 else None)), flush=True)
        shutil.rmtree(place_in)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(int(argument) for argument in sys.argv[2:]))
