import numpy as np
import pytest

from octn_ros.errors import PlanError
from octn_ros.planning import (
    PaperConfig,
    RasterPattern,
    baseline_surface,
    knn_baseline,
    paper_newton,
    paper_sgd,
    rectangle_raster,
)
from octn_ros.volume import Volume, VolumeGeometry

TAU = 0.4
RASTER = rectangle_raster((2e-4, -1e-4), (8e-4, 7e-4), 0.0)
GEOMETRY = VolumeGeometry((30, 64, 50), (28e-6, 14.59e-6, 14e-6), origin_m=(1e-4, -2e-4, 5e-4))


def test_newton_as_stated_finds_a_smooth_surface(any_field):
    search = paper_newton(any_field, RASTER, TAU)
    truth = any_field.depth(*RASTER.points_m.T)
    # Two central differences apart from the exact slope, Newton still ends on the level set.
    assert np.abs(search.depth_m - truth).max() < 1e-6
    assert not search.given_up.any()
    assert np.abs(search.coarse_depth_m - truth).max() < 14.59e-6
    assert "central differences over half a voxel" in search.method


def test_safeguards_hold(plane_field):
    config = PaperConfig(newton_steps=1, max_step_voxels=0.01)
    search = paper_newton(plane_field, RASTER, TAU, config)
    assert np.abs(search.depth_m - search.coarse_depth_m).max() <= 0.01 * 14.59e-6 * 1.01
    config = PaperConfig(neighbourhood_voxels=0.5, max_step_voxels=100.0)
    far = paper_newton(plane_field, RASTER, 0.69, config)
    assert np.abs(far.depth_m - far.coarse_depth_m).max() <= 0.5 * 14.59e-6 * 1.01


def test_sgd_comes_closer_to_the_level_set_and_lambda_counts(plane_field):
    truth = plane_field.depth(*RASTER.points_m.T)
    start = paper_sgd(plane_field, RASTER, TAU, PaperConfig(sgd_steps=1, learning_rate=1e-12))
    free = paper_sgd(plane_field, RASTER, TAU, PaperConfig(sgd_steps=300, smoothness=0.0))
    smooth = paper_sgd(plane_field, RASTER, TAU, PaperConfig(sgd_steps=300))
    np.testing.assert_allclose(start.depth_m, start.coarse_depth_m, atol=1e-10)
    before = np.std(start.depth_m - truth)
    assert np.std(free.depth_m - truth) < 0.1 * before
    assert np.std(smooth.depth_m - truth) < 0.5 * before
    assert np.std(np.diff(smooth.depth_m - truth, 2)) < np.std(np.diff(start.depth_m - truth, 2))
    assert "canonical" in smooth.method


def test_tau_is_the_median_of_the_coarse_points(plane_field):
    assert paper_newton(plane_field, RASTER).tau[0] == pytest.approx(0.4, abs=0.02)
    with pytest.raises(PlanError, match="positive surface intensity"):
        paper_newton(plane_field, RASTER, -1.0)


def stairs():
    """A volume with a sharp edge between voxels at known places, and where it lies [bscan, lateral]."""
    bscan, lateral = np.meshgrid(np.arange(30), np.arange(50), indexing="ij")
    edge = 20 + (bscan // 5) + (lateral // 10)
    voxels = np.where(np.arange(64)[None, :, None] > edge[:, None, :], 0.8, 0.1).astype(np.float32)
    return Volume(voxels, GEOMETRY, (0.0, 1.0)), edge


def pattern(index):
    """Raster points at voxel columns (bscan, lateral) [N, 2]."""
    points = np.column_stack([index[:, 1] * 14e-6 + 1e-4, index[:, 0] * 28e-6 - 2e-4])
    return RasterPattern(points, np.zeros(len(index), dtype=np.int32))


def test_the_baseline_takes_the_nearest_voxel_column():
    volume, edge = stairs()
    index = np.random.default_rng(0).integers((29, 49), size=(200, 2))
    search = knn_baseline(volume, pattern(index + np.array([0.2, 0.3])))
    expected = 5e-4 + (edge[index[:, 0], index[:, 1]] + 0.5) * 14.59e-6
    np.testing.assert_allclose(search.depth_m, expected, atol=1e-9)
    assert not search.given_up.any()
    assert set(search.seconds) == {"surface", "tree", "query"}
    assert "nearest one in the lateral plane" in search.method
    assert search.tau[0] == pytest.approx(0.45)


def test_a_surface_at_hand_gives_the_same_and_costs_the_query_alone():
    volume, _ = stairs()
    points = pattern(np.random.default_rng(1).uniform((0, 0), (29, 49), size=(50, 2)))
    warm = knn_baseline(baseline_surface(volume), points)
    np.testing.assert_array_equal(warm.depth_m, knn_baseline(volume, points).depth_m)
    assert warm.seconds["surface"] == warm.seconds["tree"] == 0.0
    assert warm.seconds["query"] > 0.0


def test_what_the_baseline_refuses():
    volume, _ = stairs()
    with pytest.raises(PlanError, match="raster point 0"):
        knn_baseline(volume, pattern(np.array([[1.0, 100.0]])))
