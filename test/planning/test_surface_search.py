import dataclasses
import math

import numpy as np
import pytest
import torch

from octn_ros.errors import ConfigurationError, PlanError
from octn_ros.field import InterpolatedField
from octn_ros.metrics import surface_distance
from octn_ros.planning import (
    CoarseSurfaceConfig,
    GiveUp,
    RasterConfig,
    RasterPattern,
    SurfaceSearchConfig,
    find_surface,
    rectangle_raster,
)
from octn_ros.planning.axial_root import AxialLines, Brackets, bracket_rises, refine_roots
from octn_ros.planning.step_levels import StepLevels
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import Volume, VolumeGeometry, gaussian_filter

TAU = 0.4  # the middle of air and tissue, so that the level set is the true surface
RASTER = rectangle_raster((2e-4, -1e-4), (8e-4, 7e-4), 0.0)


def points_of(points_m):
    return RasterPattern(points_m, np.zeros(len(points_m), dtype=np.int32))


def test_smooth_surfaces_are_found_to_a_tenth_of_a_micrometre(any_field):
    search = find_surface(any_field, RASTER, TAU, SurfaceSearchConfig(convergence=1e-5))
    assert not search.given_up.any()
    assert (search.reason == GiveUp.KEPT).all()
    truth = any_field.depth(*RASTER.points_m.T)
    assert np.abs(search.depth_m - truth).max() < 1e-7
    assert np.abs(search.coarse_depth_m - truth).max() < 30e-6
    np.testing.assert_allclose(search.intensity, TAU, atol=2e-5)
    np.testing.assert_allclose(search.residual, search.intensity - TAU, atol=1e-6)
    assert search.confidence.min() > 0.3
    assert set(search.seconds) == {"coarse", "refine", "check"}
    assert "chosen smoothly among 4 per A-scan" in search.method


def test_every_root_lies_within_the_convergence(any_field):
    search = find_surface(any_field, RASTER, TAU)
    assert np.abs(search.residual).max() <= 0.01 * TAU + 1e-6


def test_noise_does_not_lead_away_from_the_surface(make_field):
    def surface(x, y):
        return 1e-3 + 5e-5 * torch.sin(x / 1e-4) + 0.1 * y

    generator = torch.Generator().manual_seed(0)
    waves = torch.rand(40, 3, generator=generator) * 2 - 1
    frequency, phase = waves * torch.tensor([60.0, 90.0, 40.0]), torch.rand(40, generator=generator) * 6.28

    def noise(points):  # smooth, zero mean, standard deviation of about 0.06, as steep as a tenth of the edge
        return 0.013 * torch.cos(points.double() @ frequency.double().T + phase).sum(-1)

    field = make_field(surface, noise)
    search = find_surface(field, RASTER, TAU)
    assert search.given_up.mean() < 0.02
    kept = ~search.given_up
    distance = surface_distance(np.column_stack([RASTER.points_m, search.depth_m])[kept], field.depth)
    assert distance.spread_um < 8
    assert distance.max_um < 40


@pytest.mark.parametrize("refinement", ["newton", "least_squares"])
@pytest.mark.parametrize("axial", [(278, 5e-6), (139, 10e-6)])
def test_what_is_found_does_not_depend_on_the_axial_spacing(make_field, axial, refinement):
    def rough(x, y):  # bumps of 15 um root mean square, 0.1 mm apart
        return 1e-3 + 15e-6 * (torch.sin(x / 21e-6 + 1e4 * y) + torch.sin(y / 17e-6 - 7e3 * x))

    searches = []
    for axials, spacing_m in ((96, 14.59e-6), axial):
        field = make_field(rough)
        field.geometry = dataclasses.replace(
            field.geometry, shape=(40, axials, 64), spacing_m=(28e-6, spacing_m, 14e-6)
        )
        config = SurfaceSearchConfig(convergence=1e-4, refinement=refinement)
        searches.append(find_surface(field, RASTER, TAU, config))
    one, other = searches
    assert not one.given_up.all()
    assert (one.given_up == other.given_up).mean() > 0.98
    both = ~one.given_up & ~other.given_up
    assert both.mean() > 0.6
    apart = np.abs(one.depth_m - other.depth_m)[both]
    # Beside a point that only one of them gave up the smooth path differs.
    assert np.percentile(apart, 100 if refinement == "newton" else 90) < 1e-6
    assert np.median(np.abs(one.confidence - other.confidence)[both]) < 0.1


def test_the_air_to_tissue_crossing_is_taken(make_field):
    # A thin layer: intensity falls through tau again 40 um below the surface.
    def layer(points):
        z = field.geometry.canonical_to_metric(points.double())[..., 2]
        return -0.6 * torch.sigmoid((z - 1.04e-3) / 4e-6)

    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.noise = layer
    search = find_surface(field, RASTER, 0.3)
    assert not search.given_up.any()
    assert search.depth_m.max() < 1.02e-3


def test_the_estimated_tau_keeps_apart_from_air_under_a_sharp_edge_that_soon_fades():
    geometry = VolumeGeometry((40, 96, 72), (28e-6, 14e-6, 14e-6))
    _, axial, lateral = np.meshgrid(*(np.arange(count) for count in geometry.shape), indexing="ij")
    below = axial - (36.7 + 0.1 * lateral)  # voxels
    clean = 0.05 + 0.55 * np.clip(below + 0.5, 0, 1) * np.exp(-0.1 * below.clip(0))
    noisy = clean + np.random.default_rng(0).normal(0, 0.05, geometry.shape)
    volume = Volume(np.rint(255 * noisy.clip(0, 1)).astype(np.uint8), geometry, (0.0, 255.0), "linear")
    raster = rectangle_raster((1.5e-4, 1.5e-4), (8e-4, 9e-4), 0.0)
    search = find_surface(InterpolatedField(volume), raster)
    assert 0.1 < search.tau[0] < 0.2  # the median over the coarse surface is that of air, 0.06
    assert search.given_up.mean() < 0.02
    truth = 14e-6 * (36.7 + 0.1 * raster.points_m[:, 0] / 14e-6)
    assert np.nanmax(np.abs(search.depth_m - truth)) < 28e-6
    assert np.nanmedian(np.abs(search.depth_m - truth)) < 14e-6


SCENE = VolumeGeometry((40, 96, 64), (28e-6, 14.59e-6, 14e-6))


def scene(power):
    """A field of a mean power [bscan, axial, lateral], averaged speckle on a logarithmic display of 33 dB."""
    speckled = power * np.random.default_rng(0).gamma(4.0, 0.25, SCENE.shape)
    level = np.clip((10.0 * np.log10(speckled) + 30.0) / 33.0, 0.0, 1.0)
    return InterpolatedField(
        gaussian_filter(Volume(np.rint(255.0 * level).astype(np.uint8), SCENE, (0.0, 255.0), "log"))
    )


def scene_axes():
    """The depth z [1, axial, 1] and the lateral x [1, 1, lateral] of a scene, and how far its surface lies above z."""
    y, z, x = (np.arange(count) * spacing for count, spacing in zip(SCENE.shape, SCENE.spacing_m, strict=True))
    y, z, x = y[:, None, None], z[None, :, None], x[None, None, :]
    return z, x, z - (550e-6 + 60e-6 * np.sin(2 * np.pi * x / 600e-6) + 0.1 * y)


def scattered(below):
    """The power that tissue sends back from a depth below its surface."""
    return np.exp(-2e3 * below.clip(0)) / (1.0 + np.exp(-below / 4e-6))


SCENE_RASTER = rectangle_raster((5e-5, 6e-5), (8.2e-4, 1e-3), 0.0)


def scene_depth(points_m):
    x, y = points_m.T
    return 550e-6 + 60e-6 * np.sin(2 * np.pi * x / 600e-6) + 0.1 * y


def test_a_faint_background_beside_the_tissue_is_not_planned_on():
    z, x, below = scene_axes()
    background = 2e-3 + 2e-3 * (z > 9e-4)  # 3 dB
    search = find_surface(scene(background + scattered(below) * (x <= 3.6e-4)), SCENE_RASTER)
    everywhere = find_surface(scene(background + scattered(below)), SCENE_RASTER)
    bare = SCENE_RASTER.points_m[:, 0] > 3.9e-4
    assert search.given_up[bare].all()
    tissue = SCENE_RASTER.points_m[:, 0] < 3e-4
    assert search.given_up[tissue].mean() < 0.1
    assert np.nanmedian(np.abs(search.depth_m - everywhere.depth_m)[tissue]) < 3e-6
    assert np.nanmedian(np.abs(everywhere.depth_m - scene_depth(SCENE_RASTER.points_m))) < 20e-6


def test_a_bright_band_under_the_first_rows_is_not_taken_for_the_surface():
    z, _, below = scene_axes()
    band = np.exp(-z / 9e-5) * (z > 2.5 * 14.59e-6)  # a scanner's autocorrelation, its first three rows blanked
    search = find_surface(scene(2e-3 + scattered(below) + band), SCENE_RASTER)
    kept = ~search.given_up
    assert kept.mean() < 0.1, "so few that no plan is made"
    clean = find_surface(scene(2e-3 + scattered(below)), SCENE_RASTER)
    assert clean.given_up.mean() < 0.05


def test_a_layer_is_not_planned_on_where_the_tissue_leaves_the_scan_at_its_top():
    z, x, _ = scene_axes()
    surface = 2e-4 * (x < 3e-4) - 1e-4 * (x >= 3e-4)
    layer = 0.8 * np.exp(-2e3 * (z - 7e-4).clip(0)) * (z > 7e-4)
    search = find_surface(scene(2e-3 + scattered(z - surface) + layer), SCENE_RASTER)
    kept = ~search.given_up
    assert not kept[SCENE_RASTER.points_m[:, 0] > 3.3e-4].any()
    left = search.depth_m[SCENE_RASTER.points_m[:, 0] < 2.7e-4]
    assert np.nanmax(np.abs(left - 2e-4)) < 50e-6


def test_points_without_tissue_are_given_up_with_a_reason(make_field):
    def hole(points):  # no tissue at all right of x = 0.5 mm
        x, _, z = field.geometry.canonical_to_metric(points.double()).unbind(-1)
        return -0.6 * torch.sigmoid((z - 1e-3) / 12e-6) * (x > 5e-4)

    field = make_field(lambda x, y: 1e-3 + 0 * x)
    field.noise = hole
    search = find_surface(field, RASTER, TAU)
    right = RASTER.points_m[:, 0] > 5.2e-4
    assert search.given_up[right].all()
    assert not search.given_up[RASTER.points_m[:, 0] < 4.8e-4].any()
    for values in (search.depth_m, search.intensity, search.residual):
        assert np.array_equal(np.isnan(values), search.given_up)
    reasons = {GiveUp(code) for code in search.reason[right]}
    assert reasons <= {GiveUp.FLAT, GiveUp.NO_CROSSING}
    assert all("does not rise through tau" in reason.text for reason in reasons)


def test_roots_stay_in_the_neighbourhood_of_the_coarse_surface(any_field):
    config = SurfaceSearchConfig(neighbourhood_m=14.59e-6, warmup_candidates=2)
    search = find_surface(any_field, RASTER, TAU, config)
    assert np.nanmax(np.abs(search.depth_m - search.coarse_depth_m)) <= 14.59e-6 * 1.0001


def test_bisection_finds_what_newton_cannot_reach(plane_field):
    # Steps of a thousandth of a voxel get nowhere, so the sign change has to be bisected.
    config = SurfaceSearchConfig(newton_steps=1, max_step_m=15e-9)
    search = find_surface(plane_field, RASTER, TAU, config)
    assert not search.given_up.any()
    assert np.abs(search.residual).max() <= 0.01 * TAU + 1e-6


def lines_of(field, count=5):
    zeros = torch.zeros(count)
    return AxialLines(field, zeros, zeros)


def test_slope_is_per_voxel(plane_field):
    lines, every = lines_of(plane_field), torch.arange(5)
    depth = torch.linspace(30.0, 50.0, 5)
    _, slope = lines.value_and_slope(depth, every)
    step = 1e-2
    ends = lines.values(torch.stack((depth + step, depth - step), dim=1), every)
    expected = (ends[:, 0] - ends[:, 1]) / (2 * step)
    torch.testing.assert_close(slope, expected, atol=1e-4, rtol=1e-2)


def test_brackets_hold_the_sign_change(plane_field):
    lines = lines_of(plane_field, 1)
    x, y, _ = plane_field.geometry.canonical_to_metric(np.zeros(3))
    truth = (float(plane_field.depth(x, y)) - 5e-4) / 14.59e-6
    brackets = bracket_rises(lines, torch.tensor([TAU]), torch.tensor([truth + 2.3]), 4.0, 9)
    assert brackets.found.all()
    assert float(brackets.low) <= truth <= float(brackets.high)
    assert float(brackets.high - brackets.low) == pytest.approx(1.0, abs=1e-4)
    away = bracket_rises(lines, torch.tensor([TAU]), torch.tensor([truth + 20.0]), 4.0, 9)
    assert not away.found.any()
    assert float(away.high - away.low) == pytest.approx(8.0)


def test_a_flat_line_stays_where_it_is(plane_field):
    ends = torch.full((5,), 2.0), torch.full((5,), 6.0)
    brackets = Brackets(*ends, torch.full((5,), 4.0), torch.zeros(5, dtype=torch.bool))
    tau = torch.full((5,), TAU)
    roots = refine_roots(
        lines_of(plane_field), tau, brackets, steps=5, min_slope=1e-3, max_step=2.0, tolerance=0.01 * tau
    )
    torch.testing.assert_close(roots.depth, torch.full((5,), 4.0))
    assert (roots.slope < 1e-3).all()


@pytest.mark.parametrize("tau", [0.0, -0.1, math.nan, math.inf])
def test_tau_must_be_a_positive_number(plane_field, tau):
    with pytest.raises(PlanError, match="positive surface intensity tau, got"):
        find_surface(plane_field, RASTER, tau)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.array([[5e-4, 0.0], [0.05e-3, 0.0]]), r"raster point 1 at \(0\.050, 0\.000\) mm"),
        (np.array([[5e-4, 9e-4]]), r"y from -0\.200 to 0\.892 mm"),
        (np.array([[5e-4, math.nan]]), r"raster point 0 at \(0\.500, nan\) mm"),
        (np.zeros((0, 2)), "N > 0"),
        (np.zeros((3, 3)), "an array of shape"),
    ],
)
def test_points_outside_the_field(plane_field, points, words):
    with pytest.raises(PlanError, match=words):
        find_surface(plane_field, points_of(points), TAU)


def test_one_point_and_a_corner_of_the_field_will_do(plane_field):
    low = np.array(plane_field.geometry.origin_m[:2])
    high = low + plane_field.geometry.extent_m[:2]
    search = find_surface(plane_field, points_of(np.stack([low, high])), TAU)
    assert not search.given_up.any()
    assert not find_surface(plane_field, points_of(low[None]), TAU).given_up.any()


def test_more_candidates_than_an_ascan_has_places(plane_field):
    config = SurfaceSearchConfig(coarse=CoarseSurfaceConfig(candidates=32))
    levels = StepLevels.of(np.zeros((3, 3, 8), dtype=np.float32), 1, (0, 0))
    assert levels.candidates(32)[0].shape == (3, 3, 9)
    assert not find_surface(plane_field, RASTER, TAU, config).given_up.any()


def test_a_field_upside_down_has_no_surface(make_field):
    field = make_field(lambda x, y: 1e-3 + 0 * x)
    upright = field.evaluate
    field.evaluate = lambda points: 1.0 - upright(points)
    with pytest.raises(PlanError, match=r"no surface to plan on: .*upside down"):
        find_surface(field, RASTER, TAU)


def test_settings_are_checked():
    with pytest.raises(ConfigurationError, match="warmup_candidates: expected at least 2"):
        SurfaceSearchConfig(warmup_candidates=1)
    with pytest.raises(ConfigurationError, match="tolerance: expected at most"):
        SurfaceSearchConfig(tolerance=2.0)


def test_outliers_of_speckle_get_a_second_look(monkeypatch):
    phantom = make_phantom(named_phantom("wavy-13dB-single-look", shape=(64, 160, 128), seed=5, tissue_seed=5))
    field = InterpolatedField(phantom.volume)
    centre = np.array(field.geometry.extent_m[:2]) / 2
    raster = rectangle_raster(centre - 0.75e-3, centre + 0.75e-3, 0.0, RasterConfig(point_spacing_along="lateral"))

    def kept_and_distance():
        search = find_surface(field, raster)
        points = np.column_stack([raster.points_m, search.depth_m])
        kept = ~search.given_up
        assert np.abs(search.residual[kept]).max() <= 0.05 * search.tau[0]
        return kept, phantom.surface.distance(np.where(kept[:, None], points, 0.0))

    kept, distance = kept_and_distance()
    monkeypatch.setattr("octn_ros.planning.surface_search._look_again", lambda *given: False)
    once, _ = kept_and_distance()
    regained = kept & ~once
    assert kept[once].mean() > 0.998
    assert 0.005 < regained.mean() < 0.05
    assert np.abs(distance[regained] - np.median(distance[once & kept])).max() < 45e-6
    assert np.std(distance[regained]) < 1.5 * np.std(distance[once & kept])
