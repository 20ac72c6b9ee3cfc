"""The stated loss of a field's float16 message."""

import pytest
import torch

from octn_ros.errors import CheckpointError
from octn_ros.field import FieldDescription, NeuralField, NeuralFieldConfig, NeuralModel, dumps_field, loads_field
from octn_ros.field.hash_grid import HashGridConfig
from octn_ros.training.half_precision import half_precision_loss
from octn_ros.volume import VolumeGeometry

GEOMETRY = VolumeGeometry((20, 40, 30), (28e-6, 14e-6, 14e-6))
CONFIG = NeuralFieldConfig(grid=HashGridConfig(levels=3, log2_table_size=12))


def field_of(scale=1.0):
    torch.manual_seed(4)
    model = NeuralModel(CONFIG, GEOMETRY.shape)
    with torch.no_grad():
        model.grid.table.uniform_(-scale, scale)
    return NeuralField(model, CONFIG, FieldDescription("neural", GEOMETRY, (0.0, 1.0), "log"))


def test_it_is_what_a_receiver_sees_on_the_whole_scan():
    field = field_of()
    received = loads_field(dumps_field(field, half=True))
    axes = [torch.linspace(-1.0, 1.0, n) for n in GEOMETRY.shape]
    difference = received.lattice(axes[2], axes[1], axes[0]) - field.lattice(axes[2], axes[1], axes[0])
    loss = half_precision_loss(field)
    assert loss.rms == pytest.approx(float(difference.square().mean().sqrt()), rel=0.1)
    assert 0.5 * float(difference.abs().max()) <= loss.largest <= float(difference.abs().max()) * 1.01
    assert 0.0 < loss.rms < loss.largest < 1e-2


def test_a_field_that_float16_holds_exactly_loses_nothing():
    rounded = loads_field(dumps_field(field_of(), half=True))
    loss = half_precision_loss(rounded)
    assert (loss.rms, loss.largest) == (0.0, 0.0)


def test_parameters_beyond_float16_are_refused():
    with pytest.raises(CheckpointError, match="infinite"):
        half_precision_loss(field_of(scale=1e6))
