"""`octn convert`: from any format, changed as asked, into a file that keeps what is known."""

import json
import subprocess
import sys

import numpy as np
import pytest

from octn_ros.cli import main
from octn_ros.volume import load_volume, median_filter


def convert(*arguments):
    return main(["convert", *map(str, arguments)])


@pytest.mark.parametrize("suffix", [".nii", ".npz", ".tif"])
def test_nothing_is_lost_on_the_way(scan_file, tmp_path, suffix, capsys):
    output = tmp_path / f"copy{suffix}"
    assert convert(scan_file, output, "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["shape"], values["intensity_scale"]) == ([14, 24, 16], "log")
    before, after = load_volume(scan_file), load_volume(output)
    np.testing.assert_array_equal(after.array, before.array)
    assert (after.geometry, after.intensity_range) == (before.geometry, before.intensity_range)


def test_every_step_in_its_order(scan_file, tmp_path, capsys):
    output = tmp_path / "part.npz"
    steps = ("--crop-bscan", 2, 13, "--crop-axial", 4, 20, "--subsample", 2, "--filter", "median")
    assert convert(scan_file, output, *steps, "--normalise", "percentile", 1, 99, "--scale", "log") == 0
    assert "6 B-scans x 16 axial x 16 lateral" in " ".join(capsys.readouterr().out.split())
    whole, part = load_volume(scan_file), load_volume(output)
    assert part.geometry.spacing_m == pytest.approx((60e-6, 15e-6, 20e-6))
    assert part.geometry.origin_m == pytest.approx((0.0, 2 * 30e-6, 4 * 15e-6))
    inner = median_filter(load_volume(scan_file)).array  # the same at voxels whose neighbours were all kept
    assert part.array.dtype == inner.dtype
    assert 0 < part.intensity_range[0] < part.intensity_range[1] < 255
    assert part.array.max() <= whole.array[2:13, 4:20].max()


def test_linear_intensities_become_decibels(scan_file, tmp_path):
    output = tmp_path / "log.nii"
    assert convert(scan_file, output, "--scale", "linear", "--to-log", 30) == 0
    volume = load_volume(output)
    assert (volume.intensity_range, volume.intensity_scale) == ((-30.0, 0.0), "log")


def test_an_array_of_other_axes_and_a_mirrored_one(tmp_path):
    scan = np.random.default_rng(0).integers(0, 250, (4, 5, 6)).astype(np.uint8)
    np.save(tmp_path / "scan.npy", scan[::-1].transpose(1, 2, 0))
    options = ("--axes", "axial", "lateral", "bscan", "--scan-signs", "-1", "1", "1", "--spacing-um", 28, 14, 14)
    assert convert(tmp_path / "scan.npy", tmp_path / "scan.tif", *options) == 0
    np.testing.assert_array_equal(load_volume(tmp_path / "scan.tif").array, scan)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--crop-lateral", "3", "99"), "at least two lateral indices"),
        (("--subsample", "99"), "expected a factor"),
        (("--to-log", "30"), "--scale linear"),
        (("--normalise", "percentile", "5"), "expected type, minmax or percentile LOW HIGH"),
        (("--normalise", "percentile", "low", "high"), "two numbers"),
        (("--normalise", "loud"), "expected one of type, minmax, percentile"),
        (("--max-bytes", "100"), "raise the limit with --max-bytes"),
        (("--axes", "x", "y", "z"), "bscan, axial and lateral in some order"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_no_file(scan_file, tmp_path, options, message, capsys):
    output = tmp_path / "out.nii"
    assert convert(scan_file, output, *options) == 2
    error = capsys.readouterr().err
    assert error.startswith("octn convert: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not output.exists()


@pytest.mark.parametrize("name", ["out.mat", "no/folder.nii"])
def test_an_output_that_cannot_be_written(scan_file, tmp_path, name, capsys):
    assert convert(scan_file, tmp_path / name) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_convert_needs_no_torch(scan_file, tmp_path):
    code = (
        "import sys; from octn_ros.cli import main\n"
        f"code = main(['convert', {str(scan_file)!r}, {str(tmp_path / 'out.tif')!r}, '--filter', 'gaussian'])\n"
        "sys.exit(code or any(name in sys.modules for name in ('torch', 'rclpy', 'zenoh', 'matplotlib')))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
