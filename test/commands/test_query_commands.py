"""`octn slice`, `octn surface`, `octn band`: the files they write, what they print, and what they refuse."""

import json

import numpy as np
import pytest
import tifffile
import trimesh
from PIL import Image

from octn_ros.cli import main
from octn_ros.commands.slice import SLICES
from octn_ros.commands.sources import FieldSource
from octn_ros.volume import load_volume


def run_json(capsys, *arguments):
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refusal(capsys, *arguments):
    assert main([*map(str, arguments)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    return output.err.splitlines()[-1]  # after the bar of work that was begun


def test_the_slices_named_are_the_slices_there_are():
    from octn_ros.query.slice_spec import FORMS

    for kind, form in FORMS.items():
        assert f"{kind}:" in SLICES
        assert form.partition("(")[0].strip().replace(" or ", " ").split(", ")[-1].split()[0] in SLICES


def test_a_volume_is_opened_as_the_field_through_its_voxels(scan_file, field_file, unstated_file):
    assert FieldSource(scan_file).open().kind == "interpolated"
    assert FieldSource(scan_file, order="cubic").open().kind == "interpolated"
    assert FieldSource(field_file, device="cpu").open().kind == "neural"
    stated = FieldSource(unstated_file, (20.0, 5.0, 20.0)).open()
    assert stated.geometry.spacing_m == pytest.approx((2e-5, 5e-6, 2e-5))


@pytest.mark.parametrize("kind", ["volume", "field"])
def test_a_slice_as_numbers(scan_file, field_file, tmp_path, capsys, kind):
    source = scan_file if kind == "volume" else field_file
    for suffix in (".npy", ".tif"):
        path = tmp_path / f"slice{suffix}"
        values = run_json(capsys, "slice", source, "bscan:3.5", "-o", path, "--device", "cpu")
        pixels = np.load(path) if suffix == ".npy" else tifffile.imread(path)
        assert pixels.shape == (24, 16)
        assert pixels.dtype == np.float32
        measured = load_volume(scan_file).normalized()[3:5].mean(axis=0)
        assert np.abs(pixels - measured).mean() < (1e-5 if kind == "volume" else 0.1)
        assert values["quantity"] == "intensity"
        assert values["field"] == ("interpolated" if kind == "volume" else "neural")
        assert values["origin_m"] == pytest.approx([0, 3.5 * 30e-6, 0])
        assert values["down_m"] == pytest.approx([0, 0, 15e-6])
        assert values["max"] == pytest.approx(float(pixels.max()))


@pytest.mark.parametrize(
    "wanted",
    ["bscan:2", "axial:10.5", "lateral:7", "enface:mip", "enface:depth", "layer:0,0.05", "render:30,35",
     "plane:0.05,0.1,0.1;1,1,0;0,0,1;0.3,0.2;0.01"],
)  # fmt: skip
def test_every_slice_is_drawn(scan_file, tmp_path, capsys, wanted):
    path = tmp_path / "slice.png"
    values = run_json(capsys, "slice", scan_file, wanted, "-o", path)
    assert values["slice"] == wanted
    with Image.open(path) as picture:
        assert picture.size[0] == 1500
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


def test_a_map_of_the_surface(field_file, tmp_path, capsys):
    path, picture = tmp_path / "surface.csv", tmp_path / "surface.png"
    values = run_json(capsys, "surface", field_file, "-o", path, "--picture", picture, "--device", "cpu")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table.shape == (14 * 16, 5) == (values["ascans"], 5)
    truth = (8.0 + 0.1 * table[:, 0] / 20e-6 + 0.05 * table[:, 1] / 30e-6) * 15e-6
    assert np.median(np.abs(table[:, 2] - truth)) < 15e-6
    assert values["tau"] == pytest.approx(np.median(table[:, 3]), abs=1e-6)
    assert values["tau_from"] == "map"
    assert values["depth_mm"]["median"] == pytest.approx(np.median(table[:, 2]) * 1e3, abs=1e-6)
    with Image.open(picture) as drawn:
        assert drawn.size[0] == 1500


def test_a_mesh_of_the_surface_and_the_distance_to_it(scan_file, tmp_path, capsys):
    path, distance = tmp_path / "surface.ply", tmp_path / "distance.npz"
    values = run_json(
        capsys, "surface", scan_file, "-o", path, "--mesh", "--tau", "0.45", "--step-um", "12", "--distance", distance,
        "--box", "0.02", "0.28", "0.03", "0.36", "0.05", "inf",
    )  # fmt: skip
    mesh = trimesh.load_mesh(path, process=False)
    assert len(mesh.faces) == values["triangles"] > 100
    assert values["tau"] == 0.45
    assert mesh.bounds[0, 2] >= 0.05e-3 - 1e-9
    low, high = mesh.bounds[:, :2]
    assert (low >= np.array([0.02e-3, 0.03e-3]) - 1e-9).all()
    assert (high <= np.array([0.28e-3, 0.36e-3]) + 1e-9).all()
    with np.load(distance, allow_pickle=False) as found:
        assert found["distance_m"].shape == (len(found["y_m"]), len(found["z_m"]), len(found["x_m"]))
        # In the air above the surface distances are positive, in the tissue below it negative.
        assert found["distance_m"][:, 0].min() > 0 > found["distance_m"][:, -1].max()


def test_a_mesh_keeps_to_the_map(scan_file, tmp_path, capsys):
    path = tmp_path / "surface.npz"

    def deepest_um(*more):
        run_json(capsys, "surface", scan_file, "-o", path, "--mesh", "--tau", "0.6", *more)
        with np.load(path, allow_pickle=False) as mesh:
            return mesh["vertices_m"][:, 2].max() * 1e6

    # Far below the surface the signal has fallen to 0.6 again.
    assert deepest_um("--within-um", "30") < 200 < deepest_um("--within-um", "inf")


def test_the_points_of_a_band(scan_file, tmp_path, capsys):
    path, polygon = tmp_path / "band.npz", tmp_path / "polygon.txt"
    polygon.write_text("# corners in mm\n-0.01, -0.01\n0.15 -0.01\n\n0.15, 1  # far\n-0.01, 1\n")
    # No voxel lies on an end of the band, where the field's rounding would decide.
    arguments = ("band", scan_file, "0.401", "0.601", "-o", path)
    whole = run_json(capsys, *arguments, "--picture", tmp_path / "band.png")
    voxels = load_volume(scan_file).normalized()
    chosen = (voxels >= 0.401) & (voxels <= 0.601)
    assert whole["points"] == chosen.sum() > 100
    with Image.open(tmp_path / "band.png") as drawn:
        assert drawn.size[0] == 1500
    part = run_json(capsys, *arguments, "--polygon", polygon, "--box", "-1", "1", "0", "0.2", "inf", "inf")
    assert part["points"] == chosen[:7, :, :8].sum()
    assert part["searched"] < whole["searched"] == voxels.size
    with np.load(path, allow_pickle=False) as found:
        np.testing.assert_allclose(found["intensity"], voxels[:7, :, :8][chosen[:7, :, :8]], atol=1e-5)
    sphere = run_json(capsys, *arguments, "--sphere", "0.15", "0.2", "0.18", "0.08", "--half-open", "--step-um", "10")
    assert sphere["points"] > 0
    assert sphere["half_open"]


def test_tables_are_for_people(scan_file, tmp_path, capsys):
    for arguments, words in (
        (("slice", scan_file, "enface:mip", "-o", tmp_path / "a.npy"), "14 rows x 16 columns"),
        (("surface", scan_file, "-o", tmp_path / "a.ply"), "224 A-scans"),
        (("surface", scan_file, "-o", tmp_path / "a.stl", "--mesh"), "triangles"),
        (("band", scan_file, "0.4", "0.6", "-o", tmp_path / "a.ply"), "of 5,376 that were looked at"),
    ):
        assert main([*map(str, arguments)]) == 0
        assert words in capsys.readouterr().out


def test_what_cannot_be_asked_is_one_line(scan_file, field_file, unstated_file, tmp_path, capsys):
    png, ply, csv = (tmp_path / f"a{suffix}" for suffix in (".png", ".ply", ".csv"))
    (tmp_path / "bad.txt").write_text("1,2\n3,4\nfive,6\n")
    for arguments, words in (
        (("slice", scan_file, "bscan:99", "-o", png), "expected a B-scan position from 0 to 13, got 99"),
        (("slice", scan_file, "cscan:1", "-o", png), "expected a slice as bscan:POSITION"),
        (("slice", scan_file, "bscan:1", "-o", tmp_path / "a.jpg"), "as .png, .npy, .tif, .tiff"),
        (("slice", scan_file, "bscan:1", "-o", tmp_path / "no" / "a.png"), "cannot write here"),
        (("slice", field_file, "bscan:1", "-o", png, "--order", "cubic"), "--order for a C-scan only"),
        (("slice", field_file, "bscan:1", "-o", png, "--spacing-um", "1", "1", "1"), "--spacing-um for a C-scan only"),
        (("slice", unstated_file, "bscan:1", "-o", png), "--spacing-um BSCAN AXIAL LATERAL"),
        (("slice", tmp_path / "missing.nii", "bscan:1", "-o", png), "missing.nii"),
        (("slice", scan_file, "render:0,95", "-o", png), "elevation_deg"),
        (("surface", scan_file, "-o", csv, "--mesh"), "as .ply, .stl, .npz"),
        (("surface", scan_file, "-o", tmp_path / "a.stl"), "as .ply, .csv, .npz"),
        (("surface", scan_file, "-o", ply, "--step-um", "5"), "with --mesh only"),
        (("surface", scan_file, "-o", ply, "--mesh", "--tau", "2"), "level between the intensities"),
        (("surface", scan_file, "-o", ply, "--ascans", "1"), "max_ascans"),
        (("surface", scan_file, "-o", ply, "--mesh", "--within-um", "0"), "above + below > 0"),
        (("band", scan_file, "0.6", "0.4", "-o", ply), "low < high"),
        (("band", scan_file, "0.4", "0.6", "-o", ply, "--max-points", "10"), "at most 10 points"),
        (("band", scan_file, "0.4", "0.6", "-o", ply, "--box", "0", "0", "0", "1", "0", "1"), "low < high along each"),
        (("band", scan_file, "0.4", "0.6", "-o", ply, "--sphere", "9", "9", "9", "1"), "touches the scan"),
        (("band", scan_file, "0.4", "0.6", "-o", ply, "--polygon", tmp_path / "bad.txt"), "bad.txt:3: expected X,Y"),
        (("band", scan_file, "0.4", "0.6", "-o", ply, "--polygon", tmp_path / "none.txt"), "cannot read a polygon"),
    ):
        error = refusal(capsys, *arguments)
        assert words in error, arguments
        assert error.startswith(f"octn {arguments[0]}: error: ")
