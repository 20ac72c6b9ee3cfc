"""The pictures: PNGs of the right shape, drawn from ordinary and from scarce data, without pyplot."""

import io
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from octn_ros.demo import canvas, pictures
from octn_ros.demo.pictures import FitPoint, PathPicture
from octn_ros.volume import VolumeGeometry

GEOMETRY = VolumeGeometry((16, 20, 24), (28e-6, 14.59e-6, 14e-6))
LATERAL_MM, BSCAN_MM = np.arange(24) * 0.014, np.arange(16) * 0.028


def made_path(lines=6, points=8):
    x, y = np.meshgrid(np.linspace(0.05, 0.28, points), np.linspace(0.05, 0.37, lines))
    z = 0.1 + 0.05 * x + 0.02 * np.sin(20 * y)
    segment = np.repeat(np.arange(lines, dtype=np.int32), points)
    return PathPicture(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), segment)


NO_PATH = PathPicture(np.empty((0, 3)), np.empty(0, dtype=np.int32))


def opened(png):
    image = Image.open(io.BytesIO(png))
    image.load()
    assert image.format == "PNG"
    pixels = np.asarray(image.convert("L"))
    assert pixels.std() > 5, "the picture is blank"
    return image


@pytest.mark.parametrize("path", [made_path(), NO_PATH], ids=["path", "no path"])
def test_every_picture_can_be_drawn(path):
    generator = np.random.default_rng(0)
    enface = generator.random((16, 24), dtype=np.float32)
    measured, fitted = generator.random((2, 20, 24), dtype=np.float32)
    depth = 0.1 + 0.02 * generator.random((16, 24))
    depth[3, 4] = np.nan
    opened(pictures.enface_picture(enface, GEOMETRY, path))
    opened(pictures.bscan_picture(measured, fitted, GEOMETRY, 8, path, 0.1 + 0.1 * LATERAL_MM))
    opened(pictures.bscan_picture(measured, fitted, GEOMETRY, 8, path))
    opened(pictures.surface_picture(depth, LATERAL_MM, BSCAN_MM, path))
    opened(pictures.error_picture(path.points_mm, np.linspace(-5, 9, len(path.points_mm))))


def test_lines_do_not_run_from_one_segment_to_the_next():
    path = made_path(lines=6, points=8)
    pieces, depth = path.lines()
    assert pieces.shape == (6 * 7, 2, 3)
    assert depth == pytest.approx(pieces[:, :, 2].mean(axis=1))
    assert np.linalg.norm(np.diff(pieces[:, :, :2], axis=1), axis=2).max() < 0.04


def test_the_fit_curve_takes_both_stages_one_or_none():
    both = [FitPoint(0.25 * k, 0.1 / k, 10 + k, "hybrid" if k < 5 else "discrete") for k in range(1, 10)]
    for history in (both, both[:1], []):
        image = opened(pictures.fit_picture(history))
        assert image.width == canvas.WIDTH_IN * canvas.DOTS_PER_INCH


def test_the_surface_below_a_waypoint_lies_within_the_depths_shown():
    path = made_path()
    low, high = pictures._depth_limits(np.full((4, 4), np.nan), path)
    assert low < path.points_mm[:, 2].min() < path.points_mm[:, 2].max() < high


def test_pyplot_is_never_loaded():
    code = "import sys, octn_ros.demo.pictures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
