"""Which back end takes the steps of a fit, and that no step waits for the device."""

import dataclasses
import sys

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from octn_ros.errors import BackendWarning
from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.training import PRESETS, FitConfig, ResidentVoxels, VoxelSampler, fit
from octn_ros.training.losses import LossReader
from octn_ros.training.point_trainer import PointTrainer
from octn_ros.training.trainer import backend_of_fit
from octn_ros.volume import Volume

fitting = sys.modules["octn_ros.training.fit"]
SMALL = NeuralFieldConfig(HashGridConfig(levels=3, log2_table_size=8, base_resolution=4), NetworkConfig(1, 8))
FIT = FitConfig(field=SMALL, steps=40, batch=256, learning_rate=1e-3)
# What makes the host wait for a GPU: numbers read from it, sizes that depend on data, and constants sent to it.
WAITS = {
    "aten::_local_scalar_dense", "aten::nonzero", "aten::is_nonzero", "aten::lift_fresh", "aten::lift_fresh_copy",
    "aten::equal", "aten::masked_select", "aten::_unique2",
}  # fmt: skip


def noise_volume(voxel_type=np.uint8):
    array = np.random.default_rng(0).integers(0, 250, (9, 20, 17)).astype(voxel_type)
    return Volume.from_array(array, (1e-5, 1e-5, 1e-5))


def read_late(device):
    """As the losses of a GPU are read."""
    return LossReader(torch.device("cuda"))


def never():
    return False


class Watched(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.seen = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.seen.add(function._schema.name)
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("voxel_type", [np.uint8, np.uint16, np.float32])
def test_a_step_asks_the_device_for_nothing(voxel_type):
    """Told by the operations that reach the device: on the CPU they are the same, but waiting for them is free."""
    voxels = ResidentVoxels(noise_volume(voxel_type), torch.device("cpu"))
    model = NeuralModel(SMALL, voxels.geometry.shape)
    trainer = PointTrainer(model, VoxelSampler(voxels, 0), 256)
    trainer.step(1e-2, 0.2, never)  # Adam makes its state
    with Watched() as watched:
        loss = trainer.step(1e-2, 0.2, never)
    assert "aten::mse_loss" in watched.seen
    assert not watched.seen & WAITS
    with Watched() as watched:
        float(loss)
    assert watched.seen & WAITS


def test_losses_are_read_from_a_gpu_several_at_once():
    reader = LossReader(torch.device("cuda"))
    read = [reader.add(torch.tensor(float(number))) for number in range(40)]
    assert [number for number, losses in enumerate(read) if losses] == [15, 31]
    assert [loss for losses in read for loss in losses] + reader.read() == list(range(40))
    assert reader.read() == []
    reader = LossReader(torch.device("cpu"))
    assert [reader.add(0.1), reader.add(torch.tensor(0.5))] == [[0.1], [0.5]]


def test_a_fit_whose_losses_are_read_late_is_the_same(monkeypatch):
    volume = noise_volume()
    at_once = fit(volume, FIT)
    monkeypatch.setattr(fitting, "LossReader", read_late)
    late = fit(volume, FIT)
    assert torch.equal(late.field.model.grid.table, at_once.field.model.grid.table)
    assert (late.steps, late.ended, late.psnr_db) == (at_once.steps, at_once.ended, at_once.psnr_db)
    assert late.history[-1].step == FIT.steps


def test_divergence_is_noticed_late_and_the_last_good_state_put_back(monkeypatch):
    monkeypatch.setattr(fitting, "LossReader", read_late)
    batch, count = VoxelSampler.batch, iter(range(1, 10_000))

    def spoilt(self, *arguments):
        points, intensities = batch(self, *arguments)
        return points, intensities * (torch.nan if next(count) > 21 else 1.0)

    monkeypatch.setattr(VoxelSampler, "batch", spoilt)
    # A batch this large is evaluated, and its state kept, every twenty steps.
    ramp = np.linspace(0, 250, 20).astype(np.uint8)[None, :, None].repeat(9, 0).repeat(17, 2)
    volume = Volume.from_array(ramp, (1e-5, 1e-5, 1e-5))
    result = fit(volume, dataclasses.replace(FIT, steps=50, batch=1 << 14, learning_rate=1e-2))
    assert result.ended == "diverged"
    assert result.steps == 20
    assert result.field.model.grid.table.isfinite().all()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "torch"),
        ({"bricks": True}, "compiled"),
        ({"backend": "compiled"}, "compiled"),
        ({"backend": "torch", "bricks": True}, "torch"),
    ],
)
def test_the_cpu_takes_lone_samples_by_torch_and_bricks_by_kernels(changes, expected):
    model = NeuralModel(SMALL, (9, 20, 17))
    assert backend_of_fit(model, dataclasses.replace(FIT, **changes)) == expected


def test_presets_take_the_fastest_of_their_kind():
    assert {name: (preset.backend, preset.bricks) for name, preset in PRESETS.items()} == {
        "paper": ("auto", False), "fast": ("auto", True), "sparse": ("auto", False)
    }  # fmt: skip


@pytest.mark.parametrize("name", ["triton", "tiny-cuda-nn"])
def test_what_is_for_cuda_leaves_the_cpu_to_torch_with_a_warning(name):
    with pytest.warns(BackendWarning, match=f"{name} was asked for.*lie on cpu; it is for CUDA"):
        result = fit(noise_volume(), dataclasses.replace(FIT, steps=2, backend=name))
    assert result.field.description.training["backend"] == "torch"
