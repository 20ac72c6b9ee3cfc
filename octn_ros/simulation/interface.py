"""What every air-tissue interface can answer, whatever its form: points, normals, the distance to it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.errors import QueryError

# The nearest point is sought from the best of these starts: shares of the axial difference, which is an upper bound of
# the distance, in each of these directions. Steps have several foot points; one start would find any of them.
_START_SHARES = (0.35, 0.7, 0.95)
_START_DIRECTIONS = 12
_NEWTON_STEPS = 30
_CONVERGED_M = 1e-10


class Interface(ABC):
    """An interface z = s(x, y) in the OCT frame between air (smaller z) and tissue; immutable and thread-safe."""

    @abstractmethod
    def depth_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the depth z in metres at lateral `x_m` and bscan `y_m`, metres, broadcast together."""

    @abstractmethod
    def slope_at(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return dz/dx and dz/dy, without unit, at broadcast `x_m` and `y_m`."""

    @abstractmethod
    def curvature_at(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the second derivatives d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m at broadcast `x_m` and `y_m`."""

    def point_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the points [..., (x, y, z)] of the interface in metres at broadcast `x_m` and `y_m`."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        return np.stack([x, y, self.depth_at(x, y)], axis=-1)

    def normal_at(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the unit normals [..., 3] that point into the tissue (z > 0), in the OCT frame."""
        slope_x, slope_y = self.slope_at(x_m, y_m)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return normal

    def nearest_point(self, points_m: ArrayLike) -> NDArray[np.float64]:
        """Return the point of the interface nearest to each of `points_m`.

        Damped Newton steps on |p - (q, s(q))|^2 / 2 over the lateral place q, with the interface's own slope and
        curvature, from the best of several starts around the point. Exact to a nanometre on smooth interfaces.
        Where two points are about equally near, either may come back; their distances agree.

        Args:
            points_m: points [..., (x, y, z)] in the OCT frame, metres.

        Returns:
            Points [..., (x, y, z)] of the interface, metres.

        Raises:
            QueryError: the points do not have three coordinates, or one of them is not finite.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim < 1 or points.shape[-1] != 3:
            raise QueryError(f"nearest_point: expected points [..., (x, y, z)], got an array of {points.shape}")
        flat = points.reshape(-1, 3)
        if not np.isfinite(flat).all():
            bad = int(np.argmax(~np.isfinite(flat).all(axis=1)))
            raise QueryError(f"nearest_point: expected finite points, got {flat[bad]} at index {bad}")
        place = self._newton(flat, self._starts(flat))
        return self.point_at(place[:, 0], place[:, 1]).reshape(points.shape)

    def distance(self, points_m: ArrayLike) -> NDArray[np.float64]:
        """Return the signed distance of points [..., (x, y, z)] to the interface in metres, positive in the tissue.

        Raises:
            QueryError: as `nearest_point`.
        """
        points = np.asarray(points_m, dtype=np.float64)
        distance = np.linalg.norm(points - self.nearest_point(points), axis=-1)
        return np.asarray(np.copysign(distance, points[..., 2] - self.depth_at(points[..., 0], points[..., 1])))

    def _starts(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lateral place [N, 2] with the least distance of some around each point."""
        above = points[:, 2] - self.depth_at(points[:, 0], points[:, 1])
        best, least = points[:, :2].copy(), above**2
        for share in _START_SHARES:
            for angle in 2.0 * np.pi * np.arange(_START_DIRECTIONS) / _START_DIRECTIONS:
                offset = (share * np.abs(above))[:, None] * np.array([np.cos(angle), np.sin(angle)])
                place = points[:, :2] + offset
                squared = _squared(self, points, place)
                better = squared < least
                best[better], least[better] = place[better], squared[better]
        return best

    def _newton(self, points: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
        damping = np.full(len(points), 1e-3)
        least = _squared(self, points, place)
        active = np.arange(len(points))
        for _ in range(_NEWTON_STEPS):
            if not active.size:
                break
            q, p = place[active], points[active]
            slope_x, slope_y = self.slope_at(q[:, 0], q[:, 1])
            xx, xy, yy = self.curvature_at(q[:, 0], q[:, 1])
            below = p[:, 2] - self.depth_at(q[:, 0], q[:, 1])
            # Half the squared distance has this downhill direction and this Hessian.
            down_x = p[:, 0] - q[:, 0] + below * slope_x
            down_y = p[:, 1] - q[:, 1] + below * slope_y
            a = 1.0 + slope_x**2 - below * xx + damping[active]
            b = slope_x * slope_y - below * xy
            c = 1.0 + slope_y**2 - below * yy + damping[active]
            # Where the Hessian is not positive definite, it is raised until it is, and the step stays downhill.
            least_eigenvalue = 0.5 * (a + c) - np.hypot(0.5 * (a - c), b)
            raised = np.maximum(0.1 - least_eigenvalue, 0.0)
            a, c = a + raised, c + raised
            determinant = a * c - b * b
            step = np.stack([c * down_x - b * down_y, a * down_y - b * down_x], axis=-1) / determinant[:, None]
            squared = _squared(self, p, q + step)
            better = squared <= least[active]
            place[active[better]] = (q + step)[better]
            least[active[better]] = squared[better]
            damping[active] = np.where(better, damping[active] * 0.1, np.minimum(damping[active] * 10.0 + 1e-2, 1e6))
            active = active[np.hypot(step[:, 0], step[:, 1]) > _CONVERGED_M]
        return place


def _squared(interface: Interface, points: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    axial = points[:, 2] - interface.depth_at(place[:, 0], place[:, 1])
    lateral = points[:, :2] - place
    return np.asarray(lateral[:, 0] ** 2 + lateral[:, 1] ** 2 + axial**2)
