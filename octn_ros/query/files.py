"""Answers as files that other programs read: point clouds as PLY, CSV or npz, meshes as PLY, STL or npz.

Coordinates are metres of the OCT frame. PLY and STL know no units; a comment in the PLY header says so.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import FieldDescription
from octn_ros.query.mesh import SurfaceMesh

POINT_SUFFIXES = (".ply", ".csv", ".npz")
MESH_SUFFIXES = (".ply", ".stl", ".npz")
_PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_points(
    path: str | Path,
    points_m: NDArray[np.floating],
    values: Mapping[str, NDArray[Any]],
    description: FieldDescription,
) -> None:
    """Write a point cloud; the suffix says how.

    Args:
        path: a .ply (binary, float32), .csv (columns x_m, y_m, z_m and the values) or .npz file.
        points_m: (x, y, z) [N, 3] in the OCT frame.
        values: one number [N] per point for each name, "intensity" for instance.
        description: of the field the points were found in; frame, stamp and intensity scale are written with them,
            except into CSV.

    Raises:
        QueryError: another suffix, or the file cannot be written.
    """
    path, facts = Path(path), _facts(description)
    columns = dict(zip(("x", "y", "z"), points_m.T, strict=True)) | dict(values)
    if path.suffix == ".ply":
        data = _ply({"vertex": {name: np.asarray(column, "<f4") for name, column in columns.items()}}, facts)
    elif path.suffix == ".csv":
        stream = io.StringIO()
        header = ",".join(f"{name}_m" if name in "xyz" else name for name in columns)
        np.savetxt(stream, np.column_stack(list(columns.values())), "%.9g", ",", header=header, comments="")
        data = stream.getvalue().encode()
    elif path.suffix == ".npz":
        data = _npz({"points_m": points_m, **values}, facts)
    else:
        raise QueryError(f"{path}: expected points to write as {', '.join(POINT_SUFFIXES)}")
    _write(path, data)


def write_mesh(path: str | Path, mesh: SurfaceMesh) -> None:
    """Write a mesh; the suffix says how.

    Args:
        path: a .ply (binary, with normals), .stl (binary) or .npz file.
        mesh: the surface.

    Raises:
        QueryError: another suffix, or the file cannot be written.
    """
    path, facts = Path(path), _facts(mesh.description) | {"level": mesh.level}
    if path.suffix == ".ply":
        names = ("x", "y", "z", "nx", "ny", "nz")
        corners = np.hstack([mesh.vertices_m, mesh.normals]).astype("<f4")
        vertex = dict(zip(names, corners.T, strict=True))
        data = _ply({"vertex": vertex, "face": {"vertex_indices": mesh.faces.astype("<i4")}}, facts)
    elif path.suffix == ".stl":
        data = _stl(mesh)
    elif path.suffix == ".npz":
        data = _npz({"vertices_m": mesh.vertices_m, "faces": mesh.faces, "normals": mesh.normals}, facts)
    else:
        raise QueryError(f"{path}: expected a mesh to write as {', '.join(MESH_SUFFIXES)}")
    _write(path, data)


def _facts(description: FieldDescription) -> dict[str, Any]:
    geometry = description.geometry
    return {
        "unit": "metre",
        "frame": geometry.frame,
        "stamp_ns": description.stamp_ns,
        "field": description.kind,
        "intensity_scale": description.intensity_scale,
        "intensity_range": list(description.intensity_range),
        "scan_shape": list(geometry.shape),
        "scan_spacing_m": list(geometry.spacing_m),
        "scan_origin_m": list(geometry.origin_m),
    }


def _npz(arrays: Mapping[str, Any], facts: dict[str, Any]) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, description=np.array(json.dumps(facts)), **arrays)
    return stream.getvalue()


def _ply(elements: Mapping[str, Mapping[str, NDArray[Any]]], facts: dict[str, Any]) -> bytes:
    """Return a binary PLY file; a property [N, K] becomes a list of K items."""
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {name} {json.dumps(value)}" for name, value in facts.items()]
    body = b""
    for element, properties in elements.items():
        header.append(f"element {element} {len(next(iter(properties.values())))}")
        kinds: list[Any] = []
        for name, values in properties.items():
            kind = _PLY_TYPES[values.dtype.str[1:]]
            header.append(f"property {'list uchar ' if values.ndim > 1 else ''}{kind} {name}")
            kinds += [(f"length of {name}", "u1")] if values.ndim > 1 else []
            kinds.append((name, values.dtype.newbyteorder("<"), values.shape[1:]))
        rows = np.empty(len(values), dtype=kinds)
        for name, values in properties.items():
            rows[name] = values
            if values.ndim > 1:
                rows[f"length of {name}"] = values.shape[1]
        body += rows.tobytes()
    return "\n".join([*header, "end_header", ""]).encode("ascii") + body


def _stl(mesh: SurfaceMesh) -> bytes:
    corners = mesh.vertices_m[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
    rows["normal"] = normal / np.where(length > 0.0, length, 1.0)
    rows["corners"] = corners
    title = f"octn_ros, metres of {mesh.description.geometry.frame}".encode("ascii", "replace")[:80].ljust(80)
    return title + np.uint32(len(rows)).astype("<u4").tobytes() + rows.tobytes()


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise QueryError(f"{path}: cannot write here: {error.strerror or error}") from error
