"""The compiled pass over A-scans against the levels around every place."""

import numpy as np
import pytest

from octn_ros.planning.step_kernel import strongest_steps_compiled
from octn_ros.planning.step_levels import StepLevels, strongest_steps, strongest_steps_reference, voxels_of_a_box

SHAPES = [(1, 1, 5), (4, 3, 64), (9, 6, 201), (3, 17, 12)]


def speckled_steps(shape, seed):
    generator = np.random.default_rng(seed)
    depth = np.arange(shape[-1])
    surface = generator.uniform(0.1, 0.9, shape[:2])[..., None] * shape[-1]
    tissue = 0.2 + 0.5 / (1 + np.exp(surface - depth)) * np.exp(-np.maximum(depth - surface, 0) / 40)
    return (tissue + 0.1 * generator.standard_normal(shape)).astype(np.float32)


@pytest.mark.parametrize("lateral", [(0, 0), (1, 1), (3, 3), (5, 0), (1, 7)])
@pytest.mark.parametrize("box", [1, 3, 4])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_compiled_pass_finds_the_reference_s_steps(shape, box, lateral):
    ascans = speckled_steps(shape, seed=box)
    place, strength, air = strongest_steps_compiled(ascans, box, lateral, 4)
    expected = strongest_steps_reference(ascans, box, lateral, 4)
    assert place.shape == expected[0].shape == (*shape[:2], 4)
    assert (np.diff(strength, axis=-1) <= 0).all()
    order = np.argsort(-expected[1], axis=-1, kind="stable")
    expected = [np.take_along_axis(part, order, axis=-1) for part in expected]
    np.testing.assert_allclose(strength, expected[1], atol=2e-4)
    real = expected[1] > 1e-3
    assert real.any()
    np.testing.assert_array_equal(place[real], expected[0][real])
    np.testing.assert_allclose(air[real], expected[2][real], atol=1e-6)
    assert all(len(set(own)) == 4 for own in place.reshape(-1, 4).tolist())


def test_flat_a_scans_have_places_of_no_strength():
    flat = np.full((2, 3, 9), 0.3, dtype=np.float32)
    place, strength, air = strongest_steps_compiled(flat, 2, (3, 3), 32)
    assert place.shape == (2, 3, 10)
    assert sorted(place[1, 2]) == list(range(10))
    assert not strength.any()
    np.testing.assert_allclose(air, 0.3, rtol=1e-6)


def test_without_numba_the_reference_answers(monkeypatch):
    ascans = speckled_steps((3, 3, 40), seed=1)
    monkeypatch.setattr("octn_ros.planning.step_levels.numba_is_there", lambda: False)
    for part, expected in zip(
        strongest_steps(ascans, 2, (3, 3), 3), strongest_steps_reference(ascans, 2, (3, 3), 3), strict=True
    ):
        np.testing.assert_array_equal(part, expected)


def test_five_boxes_span_the_window():
    assert [voxels_of_a_box(window) for window in (0.5, 5.0, 15.1, 44.0)] == [1, 1, 3, 9]
    levels = StepLevels.of(speckled_steps((1, 1, 30), seed=0), 3, (0, 0))
    assert levels.near.shape == (1, 1, 30)
