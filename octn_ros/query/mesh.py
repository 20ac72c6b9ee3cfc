"""The surface of equal intensity f = level (eq. 7) as a triangle mesh, by marching cubes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field, FieldDescription
from octn_ros.query.lattice import Lattice
from octn_ros.query.regions import Region

_NEWTON_STEPS = 2
_CHUNK_POINTS = 1 << 17


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles of the surface f = level; read-only.

    Seen from the darker side the corners of a triangle run counter-clockwise, so normals (right-hand rule, in the OCT
    frame) point out of the brighter side: from the tissue towards the probe. A closed bright body has positive
    `signed_volume_m3`. Where the surface leaves the scan or the region, the mesh is open.

    Attributes:
        vertices_m: corners (x, y, z) [V, 3] in the OCT frame, in metres.
        faces: numbers of the three corners of each triangle [F, 3].
        normals: unit normals at the corners [V, 3], the field's own gradient turned to the darker side; 0 where the
            field is flat.
        level: the intensity.
        description: where the field comes from.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    normals: NDArray[np.float64]
    level: float
    description: FieldDescription

    @property
    def area_m2(self) -> float:
        """Sum of the triangles' areas."""
        return float(np.linalg.norm(self._doubled_normals(), axis=1).sum() / 2)

    @property
    def signed_volume_m3(self) -> float:
        """Volume that a closed mesh holds, positive if its normals point outwards."""
        # About the mesh's middle, so that a far origin costs no digits.
        first = self.vertices_m[self.faces[:, 0]] - self.vertices_m.mean(axis=0)
        return float(np.einsum("ij,ij->", first, self._doubled_normals()) / 6)

    def _doubled_normals(self) -> NDArray[np.float64]:
        a, b, c = (self.vertices_m[self.faces[:, corner]] for corner in range(3))
        return np.cross(b - a, c - a)


def iso_surface(
    field: Field,
    level: float,
    region: Region | None = None,
    step_m: float | None = None,
    *,
    max_points: int = 1 << 26,
    progress: Callable[[float], None] | None = None,
) -> SurfaceMesh:
    """Find the surface where the field's intensity equals a level, as a mesh.

    Marching cubes on a lattice, whose corners two Newton steps along the exact gradient then bring closer to the
    level, where they do: between the lattice's points the field is not linear. Not differentiable; thread-safe; any
    device. On noisy fields the level is met in speckle too: keep to a region near the surface, or to a filtered one.

    Args:
        field: the field.
        level: the intensity, such as tau of the surface.
        region: only triangles whose corners lie inside it, give or take half a lattice step, and only the box around it
            is searched; None for the whole scan.
        step_m: metres between lattice points along every axis, None for the scan's own voxels.
        max_points: largest number of lattice points; each takes 4 bytes.
        progress: called with the share that is done, 0 to 1; what it raises ends the query.

    Raises:
        QueryError: the field does not reach the level there, the region does not touch the scan or is thinner than two
            lattice points, or there are too many of them.
    """
    from skimage.measure import marching_cubes

    lattice = Lattice.over(field.geometry, region, step_m, name="iso_surface")
    if min(lattice.shape) < 2 or lattice.size > max_points:
        raise QueryError(
            f"iso_surface: expected 2 or more lattice points along each axis and at most {max_points:,} together, got "
            f"{lattice.shape} along (bscan, axial, lateral); change the region or the step"
        )
    values = np.empty(lattice.shape, dtype=np.float32)
    for planes in lattice.slabs(1 << 20):
        values[planes] = lattice.evaluate(field, planes)
        if progress:
            progress(0.8 * planes.stop / lattice.shape[0])
    low, high = float(values.min()), float(values.max())
    if not low < level < high:
        raise QueryError(
            f"iso_surface: expected a level between the intensities {low:.4f} and {high:.4f} there, got {level}"
        )
    # With "ascent" the library winds triangles so that normals point out of the bright side, in the array's own axes
    # (bscan, axial, lateral). To (x, y, z) = (lateral, bscan, axial) is an even permutation: the winding holds.
    found, faces, _, _ = marching_cubes(values, level, gradient_direction="ascent")
    vertices = _to_metres(lattice, found)
    if region is not None:
        vertices, faces = _within(region, vertices, faces)
    vertices, normals = _snap(field, vertices, level, lattice)
    if progress:
        progress(1.0)
    return SurfaceMesh(vertices, np.ascontiguousarray(faces, dtype=np.int32), normals, level, field.description)


def _to_metres(lattice: Lattice, index: NDArray[np.floating]) -> NDArray[np.float64]:
    """Map fractional indices into the lattice [V, (bscan, axial, lateral)] to metres [V, (x, y, z)]."""
    x, y, z = lattice.axes_m()
    # The last plane of a lattice may lie closer than a step, so coordinates are looked up rather than scaled.
    axes = ((x, index[:, 2]), (y, index[:, 0]), (z, index[:, 1]))
    return np.column_stack([np.interp(place, np.arange(len(axis)), axis) for axis, place in axes])


def _within(
    region: Region, vertices_m: NDArray[np.float64], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Keep the triangles whose three corners lie in a region, and the corners that these use."""
    inside = region.contains(vertices_m[:, 0], vertices_m[:, 1], vertices_m[:, 2])
    kept = faces[inside[faces].all(axis=1)]
    used, numbers = np.unique(kept, return_inverse=True)
    if not len(kept):
        raise QueryError("iso_surface: expected a region that the surface passes through, got one without a triangle")
    return vertices_m[used], numbers.reshape(kept.shape).astype(np.int32)


def _snap(
    field: Field, vertices_m: NDArray[np.float64], level: float, lattice: Lattice
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Move points [V, 3] along the gradient to the level where that brings them closer, and return normals there."""
    geometry = field.geometry
    axes = lattice.axes_m()
    reach_m = max(float(np.diff(axis).max()) for axis in axes) / 2
    low, high = np.array([axis[0] for axis in axes]), np.array([axis[-1] for axis in axes])
    scale = np.array(geometry.metres_per_canonical)
    moved, normals = vertices_m.copy(), np.zeros_like(vertices_m)
    for start in range(0, len(vertices_m), _CHUNK_POINTS):
        part = slice(start, start + _CHUNK_POINTS)
        best, at = vertices_m[part], vertices_m[part]
        error, slope = np.full(len(at), np.inf), np.zeros_like(at)
        for step in range(_NEWTON_STEPS + 1):
            canonical = torch.from_numpy(geometry.metric_to_canonical(at).astype(np.float32)).to(field.device)
            value, gradient = field.value_and_gradient(canonical)
            off = value.cpu().numpy().astype(np.float64) - level
            # Canonical (lateral, axial, bscan) to the OCT frame (x, y, z) = (lateral, bscan, axial).
            metric = (gradient.cpu().numpy().astype(np.float64) / scale)[:, [0, 2, 1]]
            better = np.abs(off) < error
            best = np.where(better[:, None], at, best)
            slope = np.where(better[:, None], metric, slope)
            error = np.where(better, np.abs(off), error)
            if step == _NEWTON_STEPS:
                break
            square = np.einsum("ij,ij->i", metric, metric)
            move = -(off / np.maximum(square, 1e-12))[:, None] * metric
            length = np.linalg.norm(move, axis=1, keepdims=True)
            # Not beyond the lattice: there the region ends, or the field has no more than its border's values.
            at = np.clip(at + move * np.minimum(1.0, reach_m / np.maximum(length, 1e-30)), low, high)
        length = np.linalg.norm(slope, axis=1, keepdims=True)
        moved[part] = best
        normals[part] = np.where(length > 0.0, -slope / np.where(length > 0.0, length, 1.0), 0.0)
    return moved, normals
