import dataclasses

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from octn_ros.errors import ConfigurationError
from octn_ros.simulation import (
    ADVERSE,
    NAMED_PHANTOMS,
    SMOOTH,
    ArtefactConfig,
    PhantomConfig,
    make_phantom,
    named_phantom,
)
from octn_ros.simulation.layers import layered_power
from octn_ros.simulation.speckle import Speckle

VOXEL_M = 14.59e-6
THIN = (40, 60, 60)  # with the voxels along (bscan, lateral) of a smaller scan


def thin(name):
    """Return the named phantom with fewer A-scans and its own axial range."""
    config = named_phantom(name)
    return dataclasses.replace(config, shape=(THIN[0], config.shape[1], THIN[2]))


@pytest.mark.parametrize("name", NAMED_PHANTOMS)
def test_every_tissue_keeps_the_papers_spacing_and_holds_the_raster(name):
    config = named_phantom(name)
    assert config.spacing_m == (28e-6, VOXEL_M, 14e-6)
    assert config.shape[0] * 28e-6 > 3.4e-3
    assert config.shape[2] * 14e-6 > 3.4e-3
    assert any(dataclasses.astuple(config.artefacts)) == (name in ADVERSE and name != "stepped")


@pytest.mark.parametrize("name", SMOOTH)
def test_truth_has_one_level_at_the_true_surface(name):
    phantom = make_phantom(dataclasses.replace(thin(name), resolution_m=40e-6))
    x = np.random.default_rng(0).uniform(0, (THIN[2] - 1) * 14e-6, 400)
    y = np.random.default_rng(1).uniform(0, (THIN[0] - 1) * 28e-6, 400)
    _, _, z = phantom.surface_point(x, y).T
    level = map_coordinates(phantom.truth.array, [y / 28e-6, z / VOXEL_M, x / 14e-6], order=3, mode="nearest")
    # Half the tissue's power but for what the point spread meets below, whatever the form of the surface.
    power = layered_power(phantom.config, np.zeros(1, np.float32))
    level_db = phantom.config.air_level_db + 10.0 * np.log10(1.0 + power)
    expected = Speckle.named("averaged", 50.0).expected_display(level_db, 50.0)
    np.testing.assert_allclose(level, expected[0], atol=5e-3)
    assert abs(level.mean() - expected[0]) < 3e-4


def test_flat_ones_lie_at_four_places_within_a_voxel():
    shares = {round(named_phantom(name).surface_depth_m / VOXEL_M % 1.0, 6) for name in SMOOTH if "flat" in name}
    assert shares == {0.0, 0.25, 0.5, 0.75}


@pytest.mark.parametrize(("name", "steepest"), [("tilted5", 5), ("tilted15", 15), ("tilted30", 30), ("steep45", 45)])
def test_steepness_is_what_the_name_says(name, steepest):
    surface = named_phantom(name).true_surface()
    x, y = np.meshgrid(np.linspace(0, 3.5e-3, 300), np.linspace(0, 3.5e-3, 300))
    lean = np.degrees(np.arccos(np.clip(surface.normal_at(x, y)[..., 2], -1, 1)))
    assert lean.max() == pytest.approx(steepest, abs=0.1)


def test_name_then_system_in_any_order_then_overrides():
    config = named_phantom("glare-8dB-grain1.2-single-look-top-layer", seed=4, shape=(64, 160, 128))
    assert (config.snr_db, config.grain_voxels, config.speckle) == (8.0, 1.2, "single-look")
    assert config.artefacts == ArtefactConfig(glare_spots=6)
    assert config.top_layer_db > 0.0
    assert (config.seed, config.shape) == (4, (64, 160, 128))
    assert named_phantom("wavy-single-look-13dB") == named_phantom("wavy-13dB-single-look")
    assert named_phantom("flat+0.5-13dB").surface_depth_m == 40.5 * VOXEL_M
    assert named_phantom("wavy", snr_db=8.0).snr_db == 8.0


def test_default_is_among_them():
    assert named_phantom("wavy-15dB-averaged") == PhantomConfig() == named_phantom("wavy")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("flatt", "did you mean 'flat'"),
        ("", "expected a name of flat"),
        ("wavy-13", "-NUMBERdB, .* after 'wavy', got '-13'"),
        ("wavy-13dBx", "got '-13dBx'"),
        ("tilted", "expected a name of"),
        ("wavy-pink", "got '-pink'"),
        ("wavy-0dB", "snr_db: expected at least 1"),
    ],
)
def test_unknown_names_are_refused_with_advice(name, message):
    with pytest.raises(ConfigurationError, match=message):
        named_phantom(name)


def test_names_of_configurations_tell_every_difference():
    names = {named_phantom(f"{name}{system}").name for name in NAMED_PHANTOMS for system in ("", "-8dB", "-top-layer")}
    assert len(names) == 3 * len(NAMED_PHANTOMS)
    config = PhantomConfig(shape=(64, 160, 128), tilt_deg=1.0, artefacts=ArtefactConfig(hairs=2), seed=7)
    assert config.name == "wavy averaged grain0 snr15 seed7 shape=64x160x128 tilt_deg=1 hairs=2"
