"""Fields with a known surface, made of formulas, and a calibration that is not the identity."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from octn_ros.field import FieldDescription
from octn_ros.field.field import DifferentiableField
from octn_ros.planning import Calibration
from octn_ros.planning.transforms import from_translation_quaternion
from octn_ros.volume import VolumeGeometry

GEOMETRY = VolumeGeometry((40, 96, 64), (28e-6, 14.59e-6, 14e-6), origin_m=(1e-4, -2e-4, 5e-4))
AIR, TISSUE, EDGE_M = 0.1, 0.7, 12e-6


class AnalyticField(DifferentiableField):
    """Intensity that rises from air to tissue as a sigmoid of the depth below a surface z = s(x, y)."""

    kind = "neural"
    device = torch.device("cpu")

    def __init__(self, surface: Callable[[Tensor, Tensor], Tensor], noise: Callable[[Tensor], Tensor] | None = None):
        self.geometry = GEOMETRY
        self.description = FieldDescription("neural", GEOMETRY, (0.0, 255.0), "log", stamp_ns=42)
        self.surface, self.noise = surface, noise

    def evaluate(self, points: Tensor) -> Tensor:
        x, y, z = self.geometry.canonical_to_metric(points.double()).unbind(-1)
        value = AIR + (TISSUE - AIR) * torch.sigmoid((z - self.surface(x, y)) / EDGE_M)
        return (value if self.noise is None else value + self.noise(points)).float()

    def depth(self, x, y):
        """True depth, for NumPy."""
        return self.surface(torch.from_numpy(np.asarray(x)), torch.from_numpy(np.asarray(y))).numpy()


def plane(x, y):
    return 1.1e-3 + 0.3 * (x - 5e-4) - 0.15 * y


def crater(x, y):
    return 9e-4 + 2e-4 * torch.exp(-((x - 5.5e-4) ** 2 + (y - 3e-4) ** 2) / (2 * 1.5e-4**2))


def sphere(x, y):
    return 2.6e-3 - torch.sqrt(1.5e-3**2 - (x - 5.5e-4) ** 2 - (y - 3e-4) ** 2)


SURFACES = {"plane": plane, "crater": crater, "sphere": sphere}


@pytest.fixture(params=list(SURFACES))
def any_field(request):
    return AnalyticField(SURFACES[request.param])


@pytest.fixture
def plane_field():
    return AnalyticField(plane)


@pytest.fixture
def make_field():
    return AnalyticField


@pytest.fixture(scope="session")
def calibration():
    pose = from_translation_quaternion((0.04, -0.02, 0.13), np.array([0.2, -0.1, 0.5, 0.8]) / np.sqrt(0.94))
    return Calibration(oct2ee=pose, laser2ee=pose)
