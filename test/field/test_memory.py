"""Evaluating many points takes little more memory than the answer."""

import subprocess
import sys

import pytest

MEASURE = """
import resource, sys
import numpy as np
import torch
from octn_ros.field import FieldDescription, HashGridConfig, InterpolatedField, NetworkConfig
from octn_ros.field import NeuralField, NeuralFieldConfig, NeuralModel
from octn_ros.volume import Volume

kind, bscans = sys.argv[1], int(sys.argv[2])
volume = Volume.from_array(np.random.default_rng(0).random((8, 16, 16)), (28e-6, 14.59e-6, 14e-6))
if kind == "neural":
    config = NeuralFieldConfig(HashGridConfig(levels=24, log2_table_size=12), NetworkConfig())
    model = NeuralModel(config, (256, 512, 512))
    field = NeuralField(model, config, FieldDescription.of_volume(volume, "neural"), backend="torch")
else:
    field = InterpolatedField(volume, order=kind)
few = torch.rand(300, 3) * 2 - 1
calls = [
    lambda points: field.evaluate(points),
    lambda points: field.axial_value_and_slope(*points.unbind(-1)),
    lambda points: field.value_and_gradient(points[: len(points) // 4]),
    lambda points: field.value_gradient_hessian(points[: len(points) // 8]),
    lambda points: field.axial_lines(points[: len(points) // 99, 0], points[: len(points) // 99, 2],
                                     points[: 99 * (len(points) // 99), 1].view(-1, 99)),
    lambda points: field.lattice(torch.linspace(-1, 1, 512), torch.linspace(-1, 1, 512),
                                 torch.linspace(-1, 1, bscans)[: max(1, len(points) * bscans // 200000)]),
]
for call in calls:
    call(few)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for call in calls:
    call(torch.rand(200000, 3) * 2 - 1)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="resident memory as Linux counts it")
@pytest.mark.parametrize(("kind", "bscans"), [("neural", 2), ("trilinear", 16), ("cubic", 16)])
def test_intermediates_stay_within_200_megabytes(kind, bscans):
    arguments = [sys.executable, "-c", MEASURE, kind, str(bscans)]
    run = subprocess.run(arguments, capture_output=True, text=True, timeout=110, check=True)
    answer = bscans * 512 * 512 * 4 >> 20
    assert int(run.stdout) < answer + 200
