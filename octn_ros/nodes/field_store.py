"""The last fitted field on disk, so that a trainer that starts again can publish it again."""

from __future__ import annotations

import contextlib
import glob
import io
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import CheckpointError, in_words
from octn_ros.field import InterpolatedField, NeuralField, field_hash, loads_field
from octn_ros.nodes.pose_history import StampedPose
from octn_ros.planning.transforms import make_rigid
from octn_ros.volume.atomic import replacing

AUTO = "auto"
_VERSION = 1
_RECORD, _FIELD, _ENFACE = "kept.json", "field.safetensors", "enface.npy"


@dataclass(frozen=True, eq=False)
class KeptField:
    """A field as it was published, and what was published with it; immutable.

    Attributes:
        data: the serialized field, as on the wire.
        hash: identity of those bytes.
        stamp_ns: acquisition time of the scan it was fitted to.
        frame: the OCT frame's name.
        enface: the scan's en-face view [bscan, lateral] in [0, 1].
        pose: the end effector's pose at the time of the scan, None if unknown.
    """

    data: bytes
    hash: str
    stamp_ns: int
    frame: str
    enface: NDArray[np.float32]
    pose: StampedPose | None = None

    def load(self) -> NeuralField | InterpolatedField:
        """Rebuild the field, on the CPU.

        Raises:
            CheckpointError: the bytes are no field.
        """
        return loads_field(self.data)


class FieldStore:
    """Keeps one field in one file, a zip archive without compression; the newer one replaces the older atomically.

    Inside are the field as `octn` commands read it, the en-face view as .npy, and a record in JSON. Nothing in it is
    ever executed. Safe from any thread as far as the file system is: of two that keep at once, one stays.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def keep(self, kept: KeptField) -> None:
        """Put a field in the place of the last one; its folder is made if need be.

        Raises:
            CheckpointError: the file cannot be written; the last one is still there.
        """
        pose = kept.pose
        record = {
            "version": _VERSION,
            "hash": kept.hash,
            "stamp_ns": kept.stamp_ns,
            "frame": kept.frame,
            "pose": pose and {"stamp_ns": pose.stamp_ns, "frame": pose.frame, "ee2base": pose.ee2base.tolist()},
        }
        view = io.BytesIO()
        np.save(view, kept.enface, allow_pickle=False)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as temporary:
                temporary.touch(mode=0o600)  # tissue of a patient is for nobody else on the machine
                with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
                    for name, part in ((_RECORD, json.dumps(record)), (_ENFACE, view.getvalue()), (_FIELD, kept.data)):
                        archive.writestr(_entry(name), part)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise CheckpointError(f"{self.path}: cannot keep the field: {reason}") from error

    def clear_leftovers(self) -> None:
        """Remove what a process left behind that was killed while it kept a field; for the only user of the file."""
        for leftover in self.path.parent.glob(f".{'?' * 12}.{glob.escape(self.path.name)}"):
            with contextlib.suppress(OSError):
                leftover.unlink()

    def load(self) -> KeptField | None:
        """Return the kept field, checked against its hash and its own header; None if none is kept.

        Raises:
            CheckpointError: the file cannot be read, is damaged, or is none of ours.
        """
        try:
            with zipfile.ZipFile(self.path) as archive:
                size = os.fstat(archive.fp.fileno()).st_size  # type: ignore[union-attr]
                parts = {name: _part(archive, name, size) for name in (_RECORD, _ENFACE, _FIELD)}
            return _checked(parts)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CheckpointError(f"{self.path}: cannot read the kept field: {error.strerror or error}") from error
        except Exception as error:  # whatever a damaged file makes its readers raise, memory that ran out included
            raise CheckpointError(f"{self.path}: the kept field is damaged: {in_words(error)}") from error


def store_path(parameter: str, node_name: str) -> Path | None:
    """Return the file that a parameter `field_path` means; None if no field is kept.

    Args:
        parameter: a path, "auto", or empty.
        node_name: the node's full name, which tells one trainer's file from another's.
    """
    if not parameter:
        return None
    if parameter != AUTO:
        return Path(parameter).expanduser()
    home = os.environ.get("ROS_HOME")
    folder = Path(home) if home else Path.home() / ".ros"
    return folder / "octn_ros" / f"{node_name.strip('/').replace('/', '.')}.field.zip"


def _entry(name: str) -> zipfile.ZipInfo:
    """Return an entry of the archive without a date, which a clock before 1980 could not give it."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o600 << 16
    return entry


def _part(archive: zipfile.ZipFile, name: str, size: int) -> bytes:
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > size:
        raise CheckpointError(f"expected {name} without compression, got {info.file_size} bytes in a file of {size}")
    return archive.read(info)


def _checked(parts: dict[str, bytes]) -> KeptField:
    record: dict[str, Any] = json.loads(parts[_RECORD])
    if record["version"] != _VERSION:
        raise CheckpointError(f"expected version {_VERSION}, got {record['version']!r}")
    pose = record["pose"]
    kept = KeptField(
        data=parts[_FIELD],
        hash=field_hash(parts[_FIELD]),
        stamp_ns=record["stamp_ns"],
        frame=record["frame"],
        enface=np.load(io.BytesIO(parts[_ENFACE]), allow_pickle=False),
        pose=pose and StampedPose(int(pose["stamp_ns"]), make_rigid(pose["ee2base"])[0], str(pose["frame"])),
    )
    if kept.hash != record["hash"]:
        raise CheckpointError(f"expected a field of hash {record['hash']}, got {kept.hash}")
    description = kept.load().description
    stated = description.stamp_ns, description.geometry.frame, description.geometry.shape[::2]
    if stated != (kept.stamp_ns, kept.frame, kept.enface.shape) or kept.enface.dtype != np.float32:
        raise CheckpointError(
            f"expected stamp, frame and en-face view of the field, {stated}, got "
            f"{(kept.stamp_ns, kept.frame, kept.enface.shape)} of {kept.enface.dtype}"
        )
    return kept
