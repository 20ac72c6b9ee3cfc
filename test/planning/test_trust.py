"""Waypoints beside what cannot be seen are held closer to their neighbours than others."""

import numpy as np

from octn_ros.planning import GiveUp, TrustConfig
from octn_ros.planning.coarse_surface import CoarseSurface
from octn_ros.planning.trust import judge
from octn_ros.volume import VolumeGeometry

GEOMETRY = VolumeGeometry((64, 128, 64), (28e-6, 14.59e-6, 28e-6))
X, Y = (axis.ravel() for axis in np.meshgrid(np.arange(30) * 50e-6, np.arange(30) * 50e-6))
POINTS = np.column_stack([X, Y])
DEPTH = 40.0
HOLE = np.hypot(X - 500e-6, Y - 700e-6) < 180e-6


def coarse_surface():
    lattice = np.arange(12) * 140e-6
    flat = np.full((12, 12), DEPTH)
    step, air = np.full((12, 12), 0.6, dtype=np.float32), np.full((12, 12), 0.1, dtype=np.float32)
    return CoarseSurface(flat, step, np.ones_like(step), air, air + step, lattice, lattice, 0.6, 0.1, 14.59e-6)


def judged(off_m, hole):
    """Reasons on rough flat tissue where every seventh point lies off by so much."""
    root = DEPTH + 5e-6 / 14.59e-6 * np.random.default_rng(0).uniform(-1.7, 1.7, len(POINTS))
    moved = np.arange(len(POINTS)) % 7 == 0
    root[moved] = DEPTH + off_m / 14.59e-6
    reason = np.where(hole, GiveUp.NO_CROSSING, GiveUp.KEPT).astype(np.int8)
    judge(GEOMETRY, coarse_surface(), POINTS, root, np.full(len(POINTS), DEPTH), reason, TrustConfig())
    return reason, moved


def test_beside_a_hole_a_waypoint_a_little_off_is_given_up_and_elsewhere_it_is_kept():
    reason, moved = judged(16e-6, HOLE)
    distance = np.hypot(X - 500e-6, Y - 700e-6)
    beside, away = ~HOLE & (distance < 230e-6), distance > 330e-6
    assert moved[beside].sum() >= 3
    assert set(reason[beside & moved]) == {GiveUp.UNCONFIRMED}
    assert (reason[away & moved] == GiveUp.KEPT).mean() > 0.95
    assert (reason[beside & ~moved] == GiveUp.KEPT).mean() > 0.8
    assert "beside places that were given up" in GiveUp.UNCONFIRMED.text


def test_lone_holes_make_nothing_doubtful():
    alone = np.zeros(len(POINTS), dtype=bool)
    alone[[95, 410, 444, 730]] = True
    reason, _ = judged(16e-6, alone)
    assert (reason[~alone] == GiveUp.KEPT).all()
