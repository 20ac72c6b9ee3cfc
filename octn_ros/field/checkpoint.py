"""Fields as bytes: safetensors with a JSON header, for files and for messages. Nothing stored is ever executed."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from octn_ros.errors import CheckpointError, ConfigurationError, VolumeError
from octn_ros.field.field import FieldDescription
from octn_ros.field.neural import NeuralField, NeuralFieldConfig, NeuralModel
from octn_ros.settings import as_plain, from_plain
from octn_ros.volume import VolumeGeometry

FORMAT = "octn-field/safetensors"
FORMAT_VERSION = 1
_HEADER_KEY = "octn_field"


def dumps_field(field: NeuralField, *, half: bool = False) -> bytes:
    """Return a neural field as safetensors bytes with its configuration, geometry and origin in the header.

    Args:
        field: the field; float32 parameters.
        half: store float16, half the size. The loss is the rounding of each parameter to 11 significant bits; the
            header names the type.
    """
    dtype = torch.float16 if half else torch.float32
    tensors = {name: t.detach().to("cpu", dtype).contiguous() for name, t in field.model.state_dict().items()}
    description = field.description
    header = {
        "version": FORMAT_VERSION,
        "dtype": "float16" if half else "float32",
        "config": {"grid": as_plain(field.config.grid), "network": as_plain(field.config.network)},
        "geometry": description.geometry.to_plain(),
        "intensity_range": list(description.intensity_range),
        "intensity_scale": description.intensity_scale,
        "stamp_ns": description.stamp_ns,
        "training": description.training,
        "software_version": description.software_version,
    }
    return save(tensors, {_HEADER_KEY: json.dumps(header)})


def loads_field(data: bytes, device: str | torch.device = "cpu") -> NeuralField:
    """Rebuild a field from `dumps_field`'s bytes.

    The header is read and checked against the tensors before anything large is allocated.

    Raises:
        CheckpointError: the bytes are truncated, not ours, of a newer version or contradict themselves.
    """
    header = _read_header(data)
    try:
        grid = header["config"]["grid"]
        config = from_plain(NeuralFieldConfig, {"grid": grid, "network": header["config"]["network"]})
        stored = header["geometry"]
        geometry = VolumeGeometry(
            tuple(stored["shape"]), tuple(stored["spacing_m"]), tuple(stored["origin_m"]), stored["frame"]
        )
        description = FieldDescription(
            kind="neural",
            geometry=geometry,
            intensity_range=tuple(header["intensity_range"]),
            intensity_scale=header["intensity_scale"],
            stamp_ns=int(header["stamp_ns"]),
            training=header["training"],
            software_version=header["software_version"],
        )
        with torch.device("meta"):
            model = NeuralModel(config, geometry.shape)
        tensors = load(data)
    except (KeyError, TypeError, ValueError, ConfigurationError, VolumeError, SafetensorError) as error:
        raise CheckpointError(f"the stored field contradicts itself: {type(error).__name__}: {error}") from error
    expected = {name: tuple(t.shape) for name, t in model.state_dict().items()}
    got = {name: tuple(t.shape) for name, t in tensors.items()}
    if expected != got:
        raise CheckpointError(f"the stored field does not fit its configuration: expected {expected}, got {got}")
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values()):
        raise CheckpointError("the stored field has NaN or infinite parameters; fit it again")
    model.load_state_dict({name: t.to(device, torch.float32) for name, t in tensors.items()}, assign=True)
    return NeuralField(model, config, description)


def save_field(path: str | Path, field: NeuralField) -> None:
    """Write a field to a file in float32, atomically: the file is the old one or the new one, never half of either.

    Raises:
        CheckpointError: the file cannot be written.
    """
    path = Path(path)
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(dumps_field(field))
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise CheckpointError(f"{path}: cannot write the field: {error}") from error


def load_field(path: str | Path, device: str | torch.device = "cpu") -> NeuralField:
    """Read a field from a file.

    Raises:
        CheckpointError: the file is missing, truncated or not a field.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot read a field: {error.strerror or error}") from error
    try:
        return loads_field(data, device)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error


def field_hash(data: bytes) -> str:
    """Return 16 hex digits that identify the content of a stored field."""
    return hashlib.sha256(data).hexdigest()[:16]


def _read_header(data: bytes) -> dict[str, Any]:
    length = int.from_bytes(data[:8], "little") if len(data) >= 8 else 0
    if length < 2 or length > len(data) - 8:
        raise CheckpointError(f"expected a field as safetensors, got {len(data)} bytes that are truncated or foreign")
    try:
        outer = json.loads(data[8 : 8 + length])
        metadata = outer.get("__metadata__") or {}
        header = json.loads(metadata[_HEADER_KEY])
        version = header["version"]
        sizes = [math.prod(entry["shape"]) for name, entry in outer.items() if name != "__metadata__"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"expected a field of this package in safetensors, got other content: {error}") from error
    if version != FORMAT_VERSION:
        raise CheckpointError(f"expected a field of format version {FORMAT_VERSION}, got {version}; update octn_ros")
    if sum(sizes) * 2 > len(data):
        raise CheckpointError(f"the stored field is truncated: its header names {sum(sizes)} parameters")
    return header
