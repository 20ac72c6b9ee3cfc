import sys

import numpy as np
import pytest
import torch

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import Box, distance_to_mesh, iso_surface, signed_distance
from octn_ros.volume import Volume, VolumeGeometry

GEOMETRY = VolumeGeometry((24, 36, 40), (28e-6, 14e-6, 15e-6), (1e-3, -2e-3, 5e-4))
CENTRE = np.array(GEOMETRY.origin_m) + np.array(GEOMETRY.extent_m) / 2
RADIUS_M = 180e-6
STEPS_M = [None, 10e-6, 30e-6]


def metres():
    index = np.stack(np.meshgrid(*map(np.arange, GEOMETRY.shape), indexing="ij"), axis=-1).astype(float)
    return GEOMETRY.voxel_to_metric(index)


def field_of(values):
    return InterpolatedField(Volume(values.astype(np.float32), GEOMETRY, (0.0, 1.0), stamp_ns=5))


@pytest.fixture(scope="module")
def ball():
    distance = np.linalg.norm(metres() - CENTRE, axis=-1) - RADIUS_M
    return field_of(1 / (1 + np.exp(distance / 15e-6)))


def below_plane():
    """Signed distance to a tilted plane, positive below it."""
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    return (metres() - CENTRE) @ normal, normal


@pytest.fixture(scope="module")
def half_space():
    """Tissue below a tilted plane: linear in between, so that trilinear interpolation has it exactly."""
    return field_of(np.clip(0.5 + below_plane()[0] / 800e-6, 0, 1))


@pytest.mark.parametrize("step_m", STEPS_M)
def test_a_sphere_has_its_place_and_its_volume_and_its_normals_point_outwards(ball, step_m):
    mesh = iso_surface(ball, 0.5, step_m=step_m)
    away = mesh.vertices_m - CENTRE
    radius = np.linalg.norm(away, axis=1)
    assert np.abs(radius - RADIUS_M).max() < 1.0e-6  # a fourteenth of the finest spacing
    # Triangles cut the sphere's curvature off, the more the larger they are.
    assert 0.98 < mesh.signed_volume_m3 / (4 / 3 * np.pi * RADIUS_M**3) < 1.0
    assert 0.98 < mesh.area_m2 / (4 * np.pi * RADIUS_M**2) < 1.0
    assert np.einsum("ij,ij->i", away / radius[:, None], mesh.normals).min() > 0.98
    assert mesh.level == 0.5
    assert mesh.description.stamp_ns == 5


@pytest.mark.parametrize("step_m", STEPS_M)
def test_a_closed_mesh_is_closed_and_turns_one_way(ball, step_m):
    mesh = iso_surface(ball, 0.5, step_m=step_m)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    # Two triangles share each edge and run along it in opposite directions.
    forward, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(forward, np.unique(edges[:, ::-1], axis=0))
    assert len(mesh.vertices_m) - len(edges) // 2 + len(mesh.faces) == 2  # Euler's number of a sphere


def test_every_triangle_faces_the_dark_side(ball, half_space):
    for field in (ball, half_space):
        mesh = iso_surface(field, 0.5, step_m=20e-6)
        a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        big = np.linalg.norm(normal, axis=1) > 1e-12
        centre = (a + b + c)[big] / 3
        step = 5e-6 * normal[big] / np.linalg.norm(normal[big], axis=1, keepdims=True)
        with torch.no_grad():
            out, into = (
                field.evaluate(torch.from_numpy(GEOMETRY.metric_to_canonical(centre + s).astype(np.float32)))
                for s in (step, -step)
            )
        assert (out < into).all()


def test_newton_steps_bring_corners_to_the_level(ball, monkeypatch):

    def off_level(mesh):
        points = torch.from_numpy(GEOMETRY.metric_to_canonical(mesh.vertices_m).astype(np.float32))
        with torch.no_grad():
            return (ball.evaluate(points) - 0.5).abs().max().item()

    snapped = iso_surface(ball, 0.5, step_m=30e-6)
    monkeypatch.setattr(sys.modules[iso_surface.__module__], "_NEWTON_STEPS", 0)
    plain = iso_surface(ball, 0.5, step_m=30e-6)
    assert off_level(snapped) < 1e-5 < 1e-3 < off_level(plain)
    np.testing.assert_array_equal(snapped.faces, plain.faces)
    error = [np.linalg.norm(m.vertices_m - CENTRE, axis=1) - RADIUS_M for m in (snapped, plain)]
    assert np.sqrt(np.mean(error[0] ** 2)) < 0.7 * np.sqrt(np.mean(error[1] ** 2))


def test_a_plane_lies_where_it_is_and_a_region_cuts_it_out(half_space):
    normal = below_plane()[1]
    region = Box(tuple(CENTRE - 1e-4), tuple(CENTRE + 1e-4))
    mesh = iso_surface(half_space, 0.5, region)
    assert np.abs((mesh.vertices_m - CENTRE) @ normal).max() < 1e-8
    np.testing.assert_allclose(mesh.normals, np.broadcast_to(-normal, mesh.normals.shape), atol=1e-3)
    assert (np.abs(mesh.vertices_m - CENTRE) <= 1e-4 + 1e-9).all()
    assert len(mesh.vertices_m) < len(iso_surface(half_space, 0.5).vertices_m)


@pytest.mark.parametrize(
    ("level", "arguments", "words"),
    [
        (1.5, {}, "level between the intensities"),
        (float("nan"), {}, "level between the intensities"),
        (0.5, {"max_points": 100}, "at most 100 together"),
        (0.5, {"region": Box((1.0e-3, -2.0e-3, 5e-4), (1.001e-3, 0.0, 1.0))}, "2 or more lattice points"),
        (0.5, {"step_m": -1.0}, "step above 0"),
    ],
)
def test_surfaces_that_are_not_there(ball, level, arguments, words):
    with pytest.raises(QueryError, match=words):
        iso_surface(ball, level, **arguments)


def test_distance_to_a_plane_is_exact(half_space):
    truth, normal = below_plane()
    found = signed_distance(half_space, 0.5)
    assert found.distance_m.shape == GEOMETRY.shape
    np.testing.assert_allclose(found.x_m, metres()[0, 0, :, 0])
    np.testing.assert_allclose(found.y_m, metres()[:, 0, 0, 1])
    np.testing.assert_allclose(found.z_m, metres()[0, :, 0, 2])
    # Where the foot of the perpendicular lies inside the scan; beyond, the nearest point is on the plane's border.
    foot = metres() - truth[..., None] * normal
    low = np.array(GEOMETRY.origin_m)
    inside = ((foot >= low + 3e-5) & (foot <= low + GEOMETRY.extent_m - 3e-5)).all(axis=-1)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(found.distance_m[inside], -truth[inside], atol=2e-8)
    assert (np.abs(found.distance_m) >= np.abs(truth) - 2e-8).all()


@pytest.mark.parametrize("step_m", [None, 20e-6])
def test_distance_to_a_sphere_is_right_to_a_tenth_of_a_voxel(ball, step_m):
    shares = []
    found = signed_distance(ball, 0.5, step_m=step_m, progress=shares.append)
    away = np.stack(np.meshgrid(found.y_m, found.z_m, found.x_m, indexing="ij"), axis=-1)[..., [2, 0, 1]] - CENTRE
    truth = np.linalg.norm(away, axis=-1) - RADIUS_M
    assert np.abs(found.distance_m - truth).max() < 1.5e-6
    assert np.sqrt(np.mean((found.distance_m - truth) ** 2)) < 1.0e-6
    assert found.distance_m.min() < -0.8 * RADIUS_M
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


def test_distance_of_single_points(ball):
    mesh = iso_surface(ball, 0.5)
    points = CENTRE + np.array([[0, 0, 2 * RADIUS_M], [RADIUS_M / 2, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(distance_to_mesh(mesh, points), np.array([1, 0.5, 1]) * RADIUS_M, atol=1e-6)
    assert distance_to_mesh(mesh, np.zeros((0, 3))).shape == (0,)
    with pytest.raises(QueryError, match=r"\[N, 3\]"):
        distance_to_mesh(mesh, np.zeros(3))
