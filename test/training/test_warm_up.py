"""Kernels compiled ahead: nothing else is touched, and nothing is raised."""

import dataclasses
import logging

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.field.compiled.lattice import _slab
from octn_ros.field.compiled.points import _part
from octn_ros.training import PRESETS, FitConfig, fit, warm_up
from octn_ros.training.brick_kernel import adam_rows, look_up, pass_lane, sum_lane
from octn_ros.volume import Volume

SMALL = NeuralFieldConfig(HashGridConfig(levels=3, log2_table_size=10), NetworkConfig(1, 8))
FIT = FitConfig(preset="test", field=SMALL, steps=3, batch=1024, backend="compiled")
KERNELS = {"fit": (adam_rows, look_up, pass_lane, sum_lane), "query": (_slab, _part)}


@pytest.mark.parametrize("voxel_type", [np.uint8, np.uint16, np.float32])
def test_a_fit_after_it_compiles_nothing_more(voxel_type):
    warm_up.warm_up(PRESETS["fast"])
    before = {kernel: len(kernel.signatures) for kernels in KERNELS.values() for kernel in kernels}
    assert all(before.values())
    array = np.random.default_rng(0).integers(0, 200, (9, 20, 17)).astype(voxel_type)
    fit(Volume.from_array(array, (1e-5, 1e-5, 1e-5)), FIT)
    assert {kernel: len(kernel.signatures) for kernel in before} == before


def test_queries_after_it_compile_nothing_more():
    warm_up.warm_up_queries()
    before = [len(kernel.signatures) for kernel in KERNELS["query"]]
    assert all(before)
    volume = Volume.from_array(np.arange(8000, dtype=np.uint16).reshape(20, 20, 20), (1e-5, 1e-5, 1e-5))
    field = fit(volume, dataclasses.replace(FIT, backend="torch")).field
    axis = torch.linspace(-1.0, 1.0, 9)
    field.lattice(axis, axis, axis)
    field.axial_value_and_slope(axis, axis, axis)
    assert [len(kernel.signatures) for kernel in KERNELS["query"]] == before


def test_the_random_state_that_seeds_fits_is_left_alone():
    before = torch.random.get_rng_state()
    warm_up.warm_up(FIT)
    assert torch.equal(before, torch.random.get_rng_state())


def test_a_compiler_that_fails_is_said_in_the_log_only(monkeypatch, caplog):
    def broken(*arguments):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(warm_up, "NeuralField", broken)
    with caplog.at_level(logging.DEBUG):
        warm_up.warm_up(FIT)
        warm_up.warm_up_queries()
    assert [record.levelname for record in caplog.records if record.exc_info] == ["DEBUG"] * 2
