import numpy as np
import pytest
import torch

from octn_ros.metrics import smoothness_energy_mm2
from octn_ros.planning import SurfaceSearchConfig, find_surface, rectangle_raster
from octn_ros.planning.axial_root import AxialLines
from octn_ros.planning.refinement import SmoothObjective, gradient_descent, least_squares, turn_mask

TAU = 0.4
RASTER = rectangle_raster((2e-4, -1e-4), (8e-4, 7e-4), 0.0)


class Ramp(AxialLines):
    """Lines whose intensity is linear in depth, so that the least squares have a closed form."""

    def value_and_slope(self, depth, lines):
        return 0.1 * (depth - self.roots[lines]) + TAU, torch.full_like(depth, 0.1)


def ramp(count=40, seed=0):
    lines = object.__new__(Ramp)
    roots = 20 + torch.from_numpy(np.random.default_rng(seed).standard_normal(count)).float()
    object.__setattr__(lines, "roots", roots)
    segment = np.repeat([0, 1], count // 2)
    weight = torch.ones(count)
    weight[7:9] = 0.0
    return SmoothObjective(lines, torch.full((count,), TAU), weight, turn_mask(segment), 0.05), roots


def dense_solution(objective, roots):
    count = len(roots)
    second = np.zeros((count - 2, count))
    for row in range(count - 2):
        second[row, row : row + 3] = 1, -2, 1
    weight = objective.weight.numpy() * 0.01
    normal = np.diag(weight) + objective.smoothness * second.T @ np.diag(objective.mask) @ second
    return np.linalg.solve(normal, weight * roots.numpy())


def test_turns_and_breaks_are_not_smoothed():
    segment = np.array([0, 0, 0, 0, 1, 1, 1])
    assert turn_mask(segment).tolist() == [1, 1, 0, 0, 1]
    depth = np.array([1.0, 1.0, 1.0, 9.0, 9.0, 9.0, 9.0])
    assert turn_mask(segment, depth, 3.0).tolist() == [1, 0, 0, 0, 1]


def test_least_squares_solve_the_linear_case_in_one_step():
    objective, roots = ramp()
    bounds = torch.full_like(roots, -100.0), torch.full_like(roots, 100.0)
    # The ridge that keeps the equations definite moves the first step by a little.
    depth = least_squares(objective, roots, *bounds, iterations=3, tolerance=1e-6)
    np.testing.assert_allclose(depth.numpy(), dense_solution(objective, roots), atol=2e-3)


def test_gradient_descent_goes_to_the_same_place_more_slowly():
    objective, roots = ramp()
    bounds = torch.full_like(roots, -100.0), torch.full_like(roots, 100.0)
    short = gradient_descent(objective, roots, *bounds, steps=20, learning_rate=0.6)
    long = gradient_descent(objective, roots, *bounds, steps=3000, learning_rate=0.6)
    exact = dense_solution(objective, roots)
    assert np.abs(long.numpy() - exact).max() < 0.02
    assert np.abs(short.numpy() - exact).max() > 0.02


def test_bounds_hold():
    objective, roots = ramp()
    for depth in (
        least_squares(objective, roots, roots - 0.1, roots + 0.1, iterations=10, tolerance=1e-4),
        gradient_descent(objective, roots, roots - 0.1, roots + 0.1, steps=100, learning_rate=0.3),
    ):
        assert float((depth - roots).abs().max()) <= 0.1 + 1e-5
        assert float((depth - roots).abs().max()) > 0.05


def test_the_configured_refinements_lower_the_objective_and_least_squares_most(make_field):
    generator = torch.Generator().manual_seed(1)
    frequency = (torch.rand(30, 3, generator=generator) * 2 - 1) * torch.tensor([80.0, 30.0, 60.0])
    phase = torch.rand(30, generator=generator) * 6.28
    field = make_field(
        lambda x, y: 1e-3 + 2e-5 * torch.sin(x / 1.5e-4) + 0.1 * y,
        lambda points: 0.006 * torch.cos(points.double() @ frequency.double().T + phase).sum(-1),
    )
    found = {}
    for refinement in ("newton", "least_squares", "sgd"):
        config = SurfaceSearchConfig(refinement=refinement, descent_steps=300)
        found[refinement] = find_surface(field, RASTER, TAU, config)
    objective = {}
    for refinement, search in found.items():
        assert not search.given_up.any()
        voxels = search.depth_m / 14.59e-6
        second = np.diff(voxels, 2) * turn_mask(RASTER.segment)
        objective[refinement] = float(np.sum(search.residual**2) + 0.07 * np.sum(second**2))
    assert objective["least_squares"] < 0.5 * objective["newton"]
    assert objective["least_squares"] <= objective["sgd"] * 1.001
    energy = {name: smoothness_energy_mm2(search.depth_m, RASTER.segment) for name, search in found.items()}
    assert energy["least_squares"] < 0.3 * energy["newton"]
    assert "sparse least squares of eq. 14" in found["least_squares"].method
    assert "300 steps of gradient descent" in found["sgd"].method


def test_the_offset_correction_moves_waypoints_and_is_told(plane_field):
    plain = find_surface(plane_field, RASTER, TAU)
    moved = find_surface(plane_field, RASTER, TAU, SurfaceSearchConfig(offset_correction_m=9e-6))
    np.testing.assert_allclose(moved.depth_m - plain.depth_m, 9e-6, atol=1e-12)
    np.testing.assert_array_equal(moved.intensity, plain.intensity)
    assert moved.offset_correction_m == 9e-6
    assert "depth corrected by +9.0 um" in moved.method


def test_an_aperture_takes_out_what_the_field_has_of_grain(make_field):
    def grain(points):  # alternates within some 40 um laterally
        return 0.08 * torch.sin(points[..., 0].double() * 70) * torch.sin(points[..., 2].double() * 90)

    field = make_field(lambda x, y: 1e-3 + 0.3 * x, grain)
    truth = field.depth(*RASTER.points_m.T)
    errors = {}
    for aperture in (0.0, 60e-6):
        search = find_surface(field, RASTER, TAU, SurfaceSearchConfig(aperture_m=aperture))
        errors[aperture] = np.nanstd(search.depth_m - truth)
    # Half of the grain's period fits into the aperture, whose disc leans as the surface does.
    assert errors[60e-6] < 0.35 * errors[0.0]


@pytest.mark.parametrize("mode", ["global", "local"])
def test_tau_local_follows_the_tissue(make_field, mode):
    def darker(points):  # tissue loses half its brightness from left to right
        x, _, z = field.geometry.canonical_to_metric(points.double()).unbind(-1)
        return -0.35 * (x - 1e-4) / 9e-4 * torch.sigmoid((z - 1e-3) / 12e-6)

    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.noise = darker
    search = find_surface(field, RASTER, None, SurfaceSearchConfig(tau_mode=mode))
    error_um = (search.depth_m - 1e-3) * 1e6
    if mode == "local":
        assert np.ptp(search.tau) > 0.08
        assert np.nanmax(np.abs(error_um)) < 1.5
    else:
        assert np.ptp(search.tau) == 0.0
        assert np.nanmax(np.abs(error_um)) > 3.0
