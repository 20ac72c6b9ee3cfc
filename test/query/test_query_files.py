import json

import numpy as np
import pytest
import trimesh

from octn_ros.errors import QueryError
from octn_ros.field import InterpolatedField
from octn_ros.query import iso_surface, write_mesh, write_points
from octn_ros.volume import Volume, VolumeGeometry

GEOMETRY = VolumeGeometry((20, 24, 22), (28e-6, 14e-6, 15e-6), (1e-3, -2e-3, 5e-4))
RADIUS_M = 100e-6


@pytest.fixture(scope="module")
def field():
    index = np.stack(np.meshgrid(*map(np.arange, GEOMETRY.shape), indexing="ij"), axis=-1).astype(float)
    centre = np.array(GEOMETRY.origin_m) + np.array(GEOMETRY.extent_m) / 2
    distance = np.linalg.norm(GEOMETRY.voxel_to_metric(index) - centre, axis=-1) - RADIUS_M
    voxels = (1 / (1 + np.exp(distance / 15e-6))).astype(np.float32)
    return InterpolatedField(Volume(voxels, GEOMETRY, (0.0, 1.0), "log", stamp_ns=12))


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_another_program_reads_the_mesh(field, tmp_path, suffix):
    mesh = iso_surface(field, 0.5)
    path = tmp_path / f"ball{suffix}"
    write_mesh(path, mesh)
    # Merged at its own scale: the reader's default is made for millimetres.
    read = trimesh.load_mesh(path, process=False)
    read.merge_vertices(merge_norm=True, digits_vertex=8)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume == pytest.approx(mesh.signed_volume_m3, rel=1e-3)
    assert read.volume > 0
    np.testing.assert_allclose(read.bounds, [mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)], atol=1e-9)
    if suffix == ".ply":
        np.testing.assert_allclose(trimesh.load_mesh(path, process=False).vertices, mesh.vertices_m, atol=1e-9)
        assert b'comment unit "metre"\ncomment frame "oct_optical_frame"\ncomment stamp_ns 12\n' in path.read_bytes()


def test_a_mesh_as_arrays(field, tmp_path):
    mesh = iso_surface(field, 0.5)
    write_mesh(tmp_path / "ball.npz", mesh)
    with np.load(tmp_path / "ball.npz", allow_pickle=False) as read:
        for name in ("vertices_m", "faces", "normals"):
            np.testing.assert_array_equal(read[name], getattr(mesh, name))
        assert json.loads(str(read["description"]))["level"] == 0.5


POINTS = np.random.default_rng(0).normal(scale=1e-3, size=(7, 3))
VALUES = {"intensity": np.linspace(0, 1, 7, dtype=np.float32), "confidence": np.linspace(1, 0, 7)}


def test_points_in_ply(field, tmp_path):
    write_points(tmp_path / "points.ply", POINTS, VALUES, field.description)
    read = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_allclose(read.vertices, POINTS, atol=1e-9)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    for name, values in VALUES.items():
        np.testing.assert_allclose(np.ravel(data[name]), values, atol=1e-7)


def test_points_in_csv_and_npz(field, tmp_path):
    write_points(tmp_path / "points.csv", POINTS, VALUES, field.description)
    assert (tmp_path / "points.csv").read_text().splitlines()[0] == "x_m,y_m,z_m,intensity,confidence"
    table = np.loadtxt(tmp_path / "points.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table, np.column_stack([POINTS, *VALUES.values()]), rtol=1e-8)
    write_points(tmp_path / "points.npz", POINTS, VALUES, field.description)
    with np.load(tmp_path / "points.npz", allow_pickle=False) as read:
        np.testing.assert_array_equal(read["points_m"], POINTS)
        np.testing.assert_array_equal(read["intensity"], VALUES["intensity"])
        facts = json.loads(str(read["description"]))
    assert facts["frame"] == "oct_optical_frame"
    assert facts["intensity_scale"] == "log"
    assert facts["stamp_ns"] == 12


@pytest.mark.parametrize("suffix", [".ply", ".csv", ".npz"])
def test_no_points_at_all(field, tmp_path, suffix):
    path = tmp_path / f"none{suffix}"
    write_points(path, np.zeros((0, 3)), {"intensity": np.zeros(0)}, field.description)
    assert path.stat().st_size > 0


def test_files_that_cannot_be(field, tmp_path):
    with pytest.raises(QueryError, match=r"as \.ply, \.csv, \.npz"):
        write_points(tmp_path / "points.obj", POINTS, VALUES, field.description)
    with pytest.raises(QueryError, match=r"as \.ply, \.stl, \.npz"):
        write_mesh(tmp_path / "mesh.obj", iso_surface(field, 0.5))
    with pytest.raises(QueryError, match="cannot write here: No such file"):
        write_points(tmp_path / "missing" / "points.ply", POINTS, VALUES, field.description)
