"""The header of a stored field: what it must say, checked before any of the content is read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import torch

from octn_ros.errors import CheckpointError, OctnError
from octn_ros.field.field import FieldDescription
from octn_ros.field.neural import NeuralFieldConfig, NeuralModel
from octn_ros.settings import as_plain, from_plain
from octn_ros.volume import IntensityScale, VolumeGeometry

# Version 1 held neural fields only and had neither "kind" nor "order".
FORMAT_VERSION = 2
_HEADER_KEY = "octn_field"
# Ours are of some kilobytes; the limit keeps a hostile one from becoming gigabytes of parsed JSON.
_LONGEST_HEADER = 1 << 20
# A scan of 2^36 voxels is 64 GB at least: who renders a field on its own grid must be able to.
_MOST_VOXELS = 1 << 36
_ITEM_BYTES = {"U8": 1, "U16": 2, "F16": 2, "F32": 4}
_VOXEL_TYPES = ("U8", "U16", "F32")
_PARAMETER_TYPES = ("F16", "F32")
# What wrong content can raise while it is taken apart.
_WRONG = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError, OctnError)


@dataclass(frozen=True)
class StoredHeader:
    """A header that fits its content.

    Attributes:
        description: where the field comes from.
        config: shape of a neural field; None for an interpolated one.
        size: bytes of the whole file.
    """

    description: FieldDescription
    config: NeuralFieldConfig | None
    size: int


def write_header(description: FieldDescription, config: NeuralFieldConfig | None) -> dict[str, str]:
    """Return the safetensors metadata for a field.

    Raises:
        CheckpointError: the training record holds something that JSON cannot.
    """
    header = {
        "version": FORMAT_VERSION,
        "kind": description.kind,
        "order": description.order,
        "config": as_plain(config) if config is not None else None,
        "geometry": description.geometry.to_plain(),
        "intensity_range": list(description.intensity_range),
        "intensity_scale": description.intensity_scale,
        "stamp_ns": description.stamp_ns,
        "training": description.training,
        "software_version": description.software_version,
    }
    try:
        return {_HEADER_KEY: json.dumps(header)}
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"the field's training record cannot be stored as JSON: {error}") from error


def header_length(prefix: bytes, size: int) -> int:
    """Return the length of the JSON that follows the first 8 bytes of a file of `size` bytes.

    Raises:
        CheckpointError: no field of ours begins like this.
    """
    length = int.from_bytes(prefix[:8], "little") if len(prefix) >= 8 else 0
    if length < 2 or length > size - 8:
        raise CheckpointError(f"expected a field as safetensors, got {size} bytes that are truncated or foreign")
    if length > _LONGEST_HEADER:
        raise CheckpointError(f"expected a field with a header of at most {_LONGEST_HEADER} bytes, got {length}")
    return length


def read_header(text: bytes, size: int) -> StoredHeader:
    """Check a header against itself and against the size of its file; allocates nothing of the claimed size.

    Args:
        text: the JSON after the first 8 bytes.
        size: bytes of the whole file.

    Raises:
        CheckpointError: it is foreign, of a newer version, or contradicts itself or the size.
    """
    try:
        outer = json.loads(text)
        header = json.loads(outer["__metadata__"][_HEADER_KEY])
        version = header["version"]
        if type(version) is not int or version < 1:
            raise ValueError(f"format version {version!r}")
    except _WRONG as error:
        raise CheckpointError(f"expected a field of this package in safetensors, got other content: {error}") from error
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"expected a field of format version {FORMAT_VERSION} or older, got {version}; update octn_ros"
        )
    try:
        description = _description(header, "neural" if version == 1 else header["kind"])
        config = _config(header["config"]) if description.kind == "neural" else None
        tensors = {name: entry for name, entry in outer.items() if name != "__metadata__"}
        _check_content(tensors, _expected(description, config), size - 8 - len(text))
    except CheckpointError:
        raise
    except _WRONG as error:
        raise CheckpointError(f"the stored field contradicts itself: {type(error).__name__}: {error}") from error
    return StoredHeader(description, config, size)


def _description(header: Mapping[str, Any], kind: Any) -> FieldDescription:
    order = header.get("order", "")
    if (kind, order) not in (("neural", ""), ("interpolated", "trilinear"), ("interpolated", "cubic")):
        raise ValueError(f"expected a neural or an interpolated field, got kind {kind!r}, order {order!r}")
    low, high = (_number(value) for value in header["intensity_range"])
    if not low < high:
        raise ValueError(f"expected an intensity range (low, high) with low < high, got {low}, {high}")
    scale, stamp_ns, training = header["intensity_scale"], header["stamp_ns"], header["training"]
    if scale not in get_args(IntensityScale):
        raise ValueError(f"expected an intensity scale of {get_args(IntensityScale)}, got {scale!r}")
    if type(stamp_ns) is not int or not 0 <= stamp_ns < 2**63:
        raise ValueError(f"expected a stamp in nanoseconds, got {stamp_ns!r}")
    if not isinstance(training, dict) or not isinstance(header["software_version"], str):
        raise TypeError("expected a training record and a software version")
    return FieldDescription(
        kind=kind,
        geometry=_geometry(header["geometry"]),
        intensity_range=(low, high),
        intensity_scale=scale,
        stamp_ns=stamp_ns,
        training=training,
        software_version=header["software_version"],
        order=order,
    )


def _geometry(stored: Mapping[str, Any]) -> VolumeGeometry:
    shape, frame = tuple(stored["shape"]), stored["frame"]
    if not all(type(n) is int for n in shape) or math.prod(shape) > _MOST_VOXELS:
        raise ValueError(f"expected a shape of at most {_MOST_VOXELS} voxels, got {shape}")
    if not isinstance(frame, str):
        raise TypeError(f"expected the name of a frame, got {frame!r}")
    spacing_m, origin_m = (tuple(_number(value) for value in stored[name]) for name in ("spacing_m", "origin_m"))
    return VolumeGeometry(shape, spacing_m, origin_m, frame)  # type: ignore[arg-type]


def _config(stored: Any) -> NeuralFieldConfig:
    if not all(isinstance(part, dict) for part in (stored, stored["grid"], stored["network"])):
        raise TypeError("expected the shapes of a grid and a network")
    return from_plain(NeuralFieldConfig, stored)


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {value!r}")
    return float(value)


def _expected(description: FieldDescription, config: NeuralFieldConfig | None) -> dict[str, tuple[int, ...]]:
    """Return the shapes that the content must have, without allocating them."""
    if config is None:
        return {"voxels": description.geometry.shape}
    with torch.device("meta"):
        model = NeuralModel(config, description.geometry.shape)
    return {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}


def _check_content(tensors: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]], size: int) -> None:
    got = {name: tuple(entry["shape"]) for name, entry in tensors.items()}
    if got != expected:
        raise CheckpointError(f"the stored field does not fit its configuration: expected {expected}, got {got}")
    allowed = _VOXEL_TYPES if "voxels" in expected else _PARAMETER_TYPES
    end = 0
    for name, entry in sorted(tensors.items(), key=lambda item: item[1]["data_offsets"][0]):
        if entry["dtype"] not in allowed:
            raise CheckpointError(f"expected {name} as one of {allowed}, got {entry['dtype']!r}")
        start, stop = entry["data_offsets"]
        wanted = math.prod(expected[name]) * _ITEM_BYTES[entry["dtype"]]
        if (type(start), type(stop)) != (int, int) or start != end or stop - start != wanted:
            raise CheckpointError(f"expected {wanted} bytes of {name} from byte {end} on, got {start!r} to {stop!r}")
        end = stop
    if end != size:
        raise CheckpointError(f"the stored field is truncated or padded: expected {end} bytes of content, got {size}")
