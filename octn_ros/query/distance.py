"""Signed distance to the tissue's surface, over a lattice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.lattice import Lattice
from octn_ros.query.mesh import SurfaceMesh, iso_surface
from octn_ros.query.regions import Region

# Triangles looked at for each point: those with the nearest centres. The nearest triangle of marching cubes, whose
# triangles are small and of similar size, is among them but for points where it makes no difference.
_CANDIDATES = 8
_CHUNK_POINTS = 1 << 16


@dataclass(frozen=True, eq=False)
class DistanceMap:
    """Distance to the surface f = level over a lattice; read-only.

    Attributes:
        distance_m: metres to the nearest point of the surface [bscan, axial, lateral], positive where the field is
            darker than the level (air), negative where it is brighter (tissue).
        x_m: x of the columns [lateral] in the OCT frame.
        y_m: y of the planes [bscan].
        z_m: z of the rows [axial].
        mesh: the surface.
    """

    distance_m: NDArray[np.float32]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    z_m: NDArray[np.float64]
    mesh: SurfaceMesh


def signed_distance(
    field: Field,
    level: float,
    region: Region | None = None,
    step_m: float | None = None,
    *,
    max_points: int = 1 << 23,
    progress: Callable[[float], None] | None = None,
) -> DistanceMap:
    """Measure how far each lattice point lies from the surface f = level, to a fraction of a voxel.

    The distance is that to the triangles of `iso_surface` over the same lattice, so surfaces outside the region do not
    count. Every patch of the level counts, speckle in the depth too. Not differentiable; thread-safe; any device.

    Args:
        field: the field.
        level: the intensity, such as tau of the surface.
        region: only the box around it is searched and measured; None for the whole scan.
        step_m: metres between lattice points along every axis, None for the scan's own voxels.
        max_points: largest number of lattice points; a million take some seconds.
        progress: called with the share that is done, 0 to 1; what it raises ends the query.

    Raises:
        QueryError: as `iso_surface`.
    """
    # The surface takes a small part of the time.
    share = 0.2
    mesh = iso_surface(
        field,
        level,
        region,
        step_m,
        max_points=max_points,
        progress=(lambda done: progress(share * done)) if progress else None,
    )
    lattice = Lattice.over(field.geometry, region, step_m, name="signed_distance")
    x, y, z = lattice.axes_m()
    distance = np.empty(lattice.shape, dtype=np.float32)
    measure = _ToMesh(mesh)
    for planes in lattice.slabs(_CHUNK_POINTS):
        bscan, axial, lateral = np.meshgrid(y[planes], z, x, indexing="ij")
        points = np.column_stack([lateral.ravel(), bscan.ravel(), axial.ravel()])
        away = measure(points).reshape(bscan.shape)
        distance[planes] = np.where(lattice.evaluate(field, planes) > level, -away, away)
        if progress:
            progress(share + (1.0 - share) * planes.stop / lattice.shape[0])
    return DistanceMap(distance, x, y, z, mesh)


def distance_to_mesh(mesh: SurfaceMesh, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the distance [N] in metres of points [N, 3] of the OCT frame to the nearest triangle of a mesh, unsigned.

    Raises:
        QueryError: the mesh has no triangles, or the points are no array [N, 3].
    """
    if points_m.ndim != 2 or points_m.shape[1] != 3:
        raise QueryError(f"distance_to_mesh: expected points (x, y, z) [N, 3], got an array of {points_m.shape}")
    measure = _ToMesh(mesh)
    parts = [measure(points_m[i : i + _CHUNK_POINTS]) for i in range(0, len(points_m), _CHUNK_POINTS)]
    return np.concatenate(parts) if parts else np.zeros(0)


class _ToMesh:
    """Distances to one mesh, whose search tree is made once."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        if not len(mesh.faces):
            raise QueryError("distance to a mesh: expected one with triangles, got none")
        # Marching cubes leaves triangles without area where the level meets a lattice point; they have no normal.
        self._corners = mesh.vertices_m[mesh.faces]
        self._tree = KDTree(self._corners.mean(axis=1))
        self._candidates = min(_CANDIDATES, len(mesh.faces))

    def __call__(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        nearest = self._tree.query(points, k=self._candidates)[1].reshape(len(points), self._candidates)
        best = np.full(len(points), np.inf)
        for candidate in nearest.T:
            np.minimum(best, _to_triangles(points, self._corners[candidate]), out=best)
        return best


def _to_triangles(points: NDArray[np.floating], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance [N] of each point [N, 3] to its own triangle [N, 3, 3]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    flat = square <= 0.0
    # Inside the prism over the triangle the distance is that to its plane, elsewhere that to one of its edges.
    above = ~flat
    edges = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along, to = end - start, points - start
        above &= np.einsum("ij,ij->i", np.cross(normal, along), to) >= 0.0
        length = np.einsum("ij,ij->i", along, along)
        share = np.einsum("ij,ij->i", to, along) / np.where(length > 0.0, length, 1.0)
        np.minimum(edges, np.linalg.norm(to - np.clip(share, 0.0, 1.0)[:, None] * along, axis=1), out=edges)
    plane = np.abs(np.einsum("ij,ij->i", normal, points - a)) / np.sqrt(np.where(flat, 1.0, square))
    return np.where(above, plane, edges)
