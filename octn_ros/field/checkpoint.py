"""Fields as bytes: safetensors with a JSON header, for files and for messages. Nothing stored is ever executed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch
from safetensors import SafetensorError

from octn_ros.errors import CheckpointError, VolumeError
from octn_ros.field.checkpoint_header import StoredHeader, header_length, read_header, write_header
from octn_ros.field.field import Field, FieldDescription
from octn_ros.field.interpolated import InterpolatedField
from octn_ros.field.neural import NeuralField, NeuralModel
from octn_ros.volume import Volume
from octn_ros.volume.atomic import replacing

FORMAT = "octn-field/safetensors"


def dumps_field(field: Field, *, half: bool = False) -> bytes:
    """Return a field as safetensors bytes with configuration, geometry, normalisation and origin in the header.

    Args:
        field: a neural field (its parameters as float32) or an interpolated one (its voxels in their own type).
        half: store a neural field's parameters as float16, half the size. The loss is the rounding of each parameter
            to 11 significant bits. Voxels are never rounded.

    Raises:
        CheckpointError: the field is of a third kind.
    """
    if isinstance(field, NeuralField):
        dtype = torch.float16 if half else torch.float32
        tensors = {name: t.detach().to("cpu", dtype).contiguous() for name, t in field.model.state_dict().items()}
        return safetensors.torch.save(tensors, write_header(field.description, field.config))
    if isinstance(field, InterpolatedField):
        return b"".join(_voxel_parts(field.volume, field.description))
    raise CheckpointError(f"expected a neural or an interpolated field to store, got {type(field).__name__}")


def volume_parts(volume: Volume, head_bytes: int = 0) -> tuple[bytes, memoryview]:
    """Return what `dumps_field` gives for the trilinear field through a volume, in two parts, and copy nothing.

    The field itself would keep the voxels as float32, and one piece of bytes would be a copy: of a large C-scan there
    is not always room for either. The second part shares the volume's memory.

    Args:
        volume: the voxels.
        head_bytes: a multiple of 8; the first part is filled with blanks to that length, where it is shorter.
    """
    description = FieldDescription.of_volume(volume, "interpolated")
    return _voxel_parts(volume, dataclasses.replace(description, order="trilinear"), head_bytes)


def loads_field(data: bytes, device: str | torch.device = "cpu") -> NeuralField | InterpolatedField:
    """Rebuild a field from `dumps_field`'s bytes, or those of an older version.

    The header is read and checked against the size before anything large is allocated.

    Args:
        data: the stored field.
        device: where the field is put.

    Raises:
        CheckpointError: the bytes are truncated, not ours, of a newer version or contradict themselves.
    """
    length = header_length(data, len(data))
    return _rebuild(read_header(data[8 : 8 + length], len(data)), data, device)


def save_field(path: str | Path, field: Field) -> None:
    """Write a field to a file, parameters as float32, atomically: the old file or the new one, never half of either.

    Raises:
        CheckpointError: the file cannot be written.
    """
    path = Path(path)
    data = dumps_field(field)
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot write the field: {error}") from error


def load_field(path: str | Path, device: str | torch.device = "cpu") -> NeuralField | InterpolatedField:
    """Read a field from a file; a file that is no field is refused after its header.

    Raises:
        CheckpointError: the file is missing, truncated or not a field.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            prefix = file.read(8)
            text = file.read(header_length(prefix, size))
            header = read_header(text, size)
            return _rebuild(header, prefix + text + file.read(size - 8 - len(text)), device)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot read a field: {error.strerror or error}") from error
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error


def field_hash(*parts: bytes | memoryview) -> str:
    """Return 16 hex digits that identify the content of a stored field, given whole or in its parts."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]


def _voxel_parts(volume: Volume, description: FieldDescription, head_bytes: int = 0) -> tuple[bytes, memoryview]:
    """Return header and content as safetensors has them; the library itself would make two copies of the voxels."""
    array = volume.array
    voxels = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    kind = f"{'F' if array.dtype.kind == 'f' else 'U'}{8 * array.itemsize}"
    content = {"dtype": kind, "shape": list(array.shape), "data_offsets": [0, array.nbytes]}
    text = json.dumps({"__metadata__": write_header(description, None), "voxels": content}, separators=(",", ":"))
    text = text.ljust(head_bytes - 8)
    text += " " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text.encode(), voxels.reshape(-1).view(np.uint8).data


def _rebuild(header: StoredHeader, data: bytes, device: str | torch.device) -> NeuralField | InterpolatedField:
    try:
        if header.config is None:
            return _interpolated(header, data, device)
        tensors = safetensors.torch.load(data)
    except (SafetensorError, VolumeError) as error:
        raise CheckpointError(f"the stored field contradicts itself: {error}") from error
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values()):
        raise CheckpointError("the stored field has NaN or infinite parameters; fit it again")
    with torch.device("meta"):
        model = NeuralModel(header.config, header.description.geometry.shape)
    model.load_state_dict({name: t.to(device, torch.float32) for name, t in tensors.items()}, assign=True)
    return NeuralField(model, header.config, header.description)


def _interpolated(header: StoredHeader, data: bytes, device: str | torch.device) -> InterpolatedField:
    origin = header.description
    voxels = safetensors.numpy.load(data)["voxels"]
    volume = Volume(voxels, origin.geometry, origin.intensity_range, origin.intensity_scale, origin.stamp_ns)
    field = InterpolatedField(volume, device, "cubic" if origin.order == "cubic" else "trilinear")
    field.description = origin
    return field
