"""A timed motion of the laser focus, and with it of the end effector, through given poses."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from octn_ros.errors import ExecutionError
from octn_ros.settings import check_settings, setting
from octn_ros.simulation.time_law import Quantity, passing_rates, passing_times

_PLACES = 12  # per leg, between which the squared rate of passing is linear
_SHARP_DEG = 60.0  # a path that turns further is not smoothed but stopped at: the turns of a raster, mostly
_UNEVEN = 5.0  # so is one whose neighbouring legs differ by more: a spline would swing out on the shorter one
_SHORTEST_M = 1e-9


@dataclass(frozen=True)
class MotionLimits:
    """What the end effector can do; the defaults are those of a small collaborative arm in a careful mode."""

    max_speed_m_s: float = setting(0.25, "largest speed of the end effector", unit="m/s", low=1e-4, high=10.0)
    max_acceleration_m_s2: float = setting(
        1.0, "largest acceleration of the end effector", unit="m/s^2", low=1e-3, high=1000.0
    )
    max_turn_deg_s: float = setting(
        60.0, "largest angular speed of the end effector", unit="deg/s", low=0.1, high=3600.0
    )
    max_turn_acceleration_deg_s2: float = setting(
        300.0, "largest angular acceleration of the end effector", unit="deg/s^2", low=1.0, high=1e6
    )

    def __post_init__(self) -> None:
        check_settings(self)


class Trajectory:
    """Poses of the laser focus over time; immutable and thread-safe.

    The focus goes through every pose on a cubic spline and halts only where it must: at both ends, where the path turns
    by more than 60 degrees, where a leg is five times as long as its neighbour, and where told to. Orientations are
    splined as rotation vectors from that of the last halt, whose rate is never below the angular speed. The limits hold
    at twelve places of each leg; in between a rough path may exceed them by a few hundredths.

    Args:
        focus2base: poses of the focus [M, 4, 4] in the base frame, metres, M >= 1.
        focus_speed_m_s: largest speed of the focus on each leg [M - 1].
        ee2laser: the end effector in the laser frame [4, 4].
        limits: of the end effector.
        pauses_s: how long the motion halts at each pose [M], 0 where it need not; None for nowhere.

    Attributes:
        times_s: when each pose is reached [M], seconds from the start.

    Raises:
        ExecutionError: legs and speeds differ by so much that the motion would never end.
    """

    def __init__(
        self,
        focus2base: NDArray[np.float64],
        focus_speed_m_s: NDArray[np.float64],
        ee2laser: NDArray[np.float64],
        limits: MotionLimits,
        pauses_s: NDArray[np.float64] | None = None,
    ) -> None:
        count = len(focus2base)
        pauses = np.zeros(count) if pauses_s is None else pauses_s
        self._last = focus2base[-1].copy()
        self.times_s = np.zeros(count)
        self._end_s = float(pauses[-1])
        if count == 1:
            return
        lengths = _leg_lengths(focus2base, ee2laser, limits)
        knots = np.concatenate(([0.0], np.cumsum(lengths)))
        halts = _halts(focus2base[:, :3, 3], lengths) | (pauses > 0.0)
        self._path, self._base = _splines(focus2base, knots, halts)
        places = np.concatenate([*np.linspace(knots[:-1], knots[1:], _PLACES, endpoint=False, axis=1), knots[-1:]])
        stops = np.zeros(len(places), dtype=np.bool_)
        stops[::_PLACES] = halts
        self._knots = knots
        poses = self._at(places)
        tool, vectors = (poses @ ee2laser)[:, :3, 3], self._continuous_turns(places)
        speeds = np.concatenate([np.repeat(focus_speed_m_s, _PLACES), focus_speed_m_s[-1:]])
        speeds[_PLACES::_PLACES] = np.minimum(speeds[_PLACES::_PLACES], speeds[_PLACES - 1 :: _PLACES])
        rates = passing_rates(
            places,
            stops,
            [
                Quantity(poses[:, :3, 3], speeds),
                Quantity(tool, limits.max_speed_m_s, limits.max_acceleration_m_s2),
                Quantity(
                    vectors, np.radians(limits.max_turn_deg_s), float(np.radians(limits.max_turn_acceleration_deg_s2))
                ),
            ],
        )
        waited = np.concatenate(([0.0], np.cumsum(np.repeat(pauses[:-1], _PLACES) * stops[:-1])))
        self._places, self._rates = places, rates
        moving_s = passing_times(places, rates)
        if not np.isfinite(moving_s).all():  # the focus would stand still on the way, maybe with the shutter open
            raise ExecutionError(
                f"expected a path that can be followed in a finite time, got legs of {lengths.min():.3g} to "
                f"{lengths.max():.3g} m at {focus_speed_m_s.min():.3g} to {focus_speed_m_s.max():.3g} m/s; leave out "
                "waypoints that lie upon each other, and make the speeds less different"
            )
        self._leaving_s = moving_s + np.append(waited[1:], waited[-1])
        self._arriving_s = moving_s + waited
        self.times_s = self._arriving_s[::_PLACES]
        self._end_s += float(self._arriving_s[-1])

    @property
    def duration_s(self) -> float:
        """Time at which the last pose is left, seconds."""
        return self._end_s

    def reached(self, time_s: float) -> int:
        """Return the number of poses reached by `time_s`, the first one included."""
        return int(np.searchsorted(self.times_s, time_s, side="right"))

    def focus_at(self, times_s: ArrayLike) -> NDArray[np.float64]:
        """Return the focus poses [..., 4, 4] at times [...] in seconds; it rests before the start and after the end."""
        times = np.asarray(times_s, dtype=np.float64)
        if len(self.times_s) == 1:
            return np.broadcast_to(self._last, (*times.shape, 4, 4)).copy()
        flat = np.clip(times.ravel(), 0.0, self.times_s[-1])
        index = np.clip(np.searchsorted(self._arriving_s, flat, side="right") - 1, 0, len(self._places) - 2)
        since = np.maximum(flat - self._leaving_s[index], 0.0)
        leg_s = self._arriving_s[index + 1] - self._leaving_s[index]
        gain = self._rates[index + 1] - self._rates[index]
        # A leg may take no time that float64 can tell beside all before it.
        rise = np.divide(gain, leg_s, out=np.zeros_like(leg_s), where=leg_s > 0.0)
        place = self._places[index] + (self._rates[index] + 0.5 * rise * since) * since
        return self._at(np.minimum(place, self._places[index + 1])).reshape(*times.shape, 4, 4)

    def _at(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        values, leg = self._path(places), self._leg(places)
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :3, 3] = values[:, :3]
        poses[:, :3, :3] = self._base[leg] @ Rotation.from_rotvec(values[:, 3:]).as_matrix()
        return poses

    def _leg(self, places: NDArray[np.float64]) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(self._knots, places, side="right") - 1, 0, len(self._knots) - 2)

    def _continuous_turns(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rotation vectors, made to go on where they begin anew after a halt."""
        vectors = self._path(places)[:, 3:]
        leg = self._leg(places)
        begins = np.flatnonzero((np.abs(np.diff(self._base, axis=0)) > 0.0).any(axis=(1, 2))) + 1
        ends = self._path(np.nextafter(self._knots[begins], 0.0))[:, 3:]
        offsets = np.zeros((len(self._base), 3))
        offsets[begins] = ends
        return vectors + np.cumsum(offsets, axis=0)[leg]


def _leg_lengths(
    poses: NDArray[np.float64], ee2laser: NDArray[np.float64], limits: MotionLimits
) -> NDArray[np.float64]:
    """Return the length of each leg [M - 1] in metres: of the focus or the tool, a turn counted as far as it takes."""
    focus = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    tool = np.linalg.norm(np.diff((poses @ ee2laser)[:, :3, 3], axis=0), axis=1)
    turn = _angles(poses[:-1, :3, :3], poses[1:, :3, :3])
    return np.maximum.reduce(
        [focus, tool, turn * limits.max_speed_m_s / np.radians(limits.max_turn_deg_s), np.full(len(focus), _SHORTEST_M)]
    )


def _angles(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).magnitude())


def _halts(focus_m: NDArray[np.float64], lengths: NDArray[np.float64]) -> NDArray[np.bool_]:
    legs = np.diff(focus_m, axis=0)
    size = np.linalg.norm(legs, axis=1)
    halts = np.ones(len(focus_m), dtype=np.bool_)
    along = np.sum(legs[1:] * legs[:-1], axis=1) < np.cos(np.radians(_SHARP_DEG)) * size[1:] * size[:-1]
    uneven = np.maximum(lengths[1:], lengths[:-1]) > _UNEVEN * np.minimum(lengths[1:], lengths[:-1])
    still = np.minimum(size[1:], size[:-1]) < _SHORTEST_M
    halts[1:-1] = along | uneven | still
    return halts


def _splines(
    poses: NDArray[np.float64], knots: NDArray[np.float64], halts: NDArray[np.bool_]
) -> tuple[PPoly, NDArray[np.float64]]:
    """Return place and rotation vector over the knots, and the orientation [M - 1, 3, 3] that each leg's begins at."""
    ends = np.flatnonzero(halts)
    pieces, bases = [], []
    for first, last in itertools.pairwise(ends):
        stretch = poses[first : last + 1]
        turns = Rotation.from_matrix(stretch[0, :3, :3].T @ stretch[:, :3, :3]).as_rotvec()
        values = np.concatenate([stretch[:, :3, 3], turns], axis=1)
        pieces.append(CubicSpline(knots[first : last + 1], values, bc_type="natural").c)
        bases.append(np.broadcast_to(stretch[0, :3, :3], (last - first, 3, 3)))
    return PPoly(np.concatenate(pieces, axis=1), knots), np.concatenate(bases)
