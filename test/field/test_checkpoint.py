import dataclasses
import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save as save_numpy
from safetensors.torch import save

from octn_ros.errors import CheckpointError
from octn_ros.field import (
    FieldDescription,
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralField,
    NeuralFieldConfig,
    NeuralModel,
    dumps_field,
    field_hash,
    load_field,
    loads_field,
    save_field,
    volume_parts,
)
from octn_ros.field.checkpoint_header import write_header
from octn_ros.volume import Volume

CONFIG = NeuralFieldConfig(
    HashGridConfig(levels=2, features=2, log2_table_size=8, base_resolution=4), NetworkConfig(1, 8)
)


@pytest.fixture
def field():
    rng = np.random.default_rng(3)
    volume = Volume.from_array(
        rng.integers(0, 256, (4, 5, 6), dtype=np.uint8),
        (28e-6, 14.59e-6, 14e-6),
        origin_m=(1e-3, 2e-3, 3e-3),
        intensity_scale="log",
        stamp_ns=123_456_789_012,
    )
    torch.manual_seed(0)
    description = FieldDescription.of_volume(volume, "neural", {"psnr_db": 31.5})
    return NeuralField(NeuralModel(CONFIG, volume.geometry.shape), CONFIG, description)


def scattered():
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def test_round_trip_is_exact_in_float32(field, tmp_path):
    save_field(tmp_path / "field.safetensors", field)
    back = load_field(tmp_path / "field.safetensors")
    assert torch.equal(back.evaluate(scattered()), field.evaluate(scattered()))
    assert back.description == field.description
    assert back.config == field.config


def test_half_precision_loses_no_more_than_its_rounding(field):
    data = dumps_field(field, half=True)
    assert len(data) < 0.8 * len(dumps_field(field))
    torch.testing.assert_close(
        loads_field(data).evaluate(scattered()), field.evaluate(scattered()), rtol=5e-3, atol=1e-4
    )


def test_the_hash_is_of_the_content(field):
    data = dumps_field(field)
    assert data == dumps_field(field)
    assert field_hash(data) == field_hash(bytes(data))
    assert field_hash(data) != field_hash(dumps_field(field, half=True))
    assert len(field_hash(data)) == 16


def test_every_truncation_is_refused(field):
    data = dumps_field(field)
    for length in [*range(0, len(data), 211), len(data) - 1]:
        with pytest.raises(CheckpointError):
            loads_field(data[:length])


@pytest.mark.parametrize("data", [b"", b"short", b"\x00" * 64, b"\xff" * 4096, b"\x10" + b"\x00" * 7 + b"[" * 16])
def test_foreign_bytes_are_refused(data):
    with pytest.raises(CheckpointError, match="expected a field"):
        loads_field(data)


def test_safetensors_of_another_program_are_refused():
    with pytest.raises(CheckpointError, match="expected a field of this package"):
        loads_field(save({"weight": torch.zeros(3)}))


def changed(field, change):
    """Store the field with an altered header."""
    data = dumps_field(field)
    length = int.from_bytes(data[:8], "little")
    outer = json.loads(data[8 : 8 + length])
    header = json.loads(outer["__metadata__"]["octn_field"])
    change(header)
    tensors = {name: t.contiguous() for name, t in field.model.state_dict().items()}
    return save(tensors, {"octn_field": json.dumps(header)})


def test_a_newer_format_says_so(field):
    with pytest.raises(CheckpointError, match="format version 2 or older, got 3; update"):
        loads_field(changed(field, lambda header: header.update(version=3)))


@pytest.mark.parametrize(
    "change",
    [
        lambda h: h["config"]["grid"].update(levels=30, log2_table_size=24),
        lambda h: h["config"]["grid"].update(unknown=1),
        lambda h: h["config"]["network"].update(neurons="many"),
        lambda h: h["geometry"].update(shape=[1, 5, 6]),
        lambda h: h["geometry"].update(spacing_m=[0, 0, 0]),
        lambda h: h.pop("geometry"),
        lambda h: h.update(stamp_ns=None),
    ],
)
def test_headers_that_contradict_the_tensors_are_refused(field, change):
    with pytest.raises(CheckpointError):
        loads_field(changed(field, change))


def test_parameters_that_are_not_finite_are_refused(field):
    with torch.no_grad():
        field.model.grid.table[0, 0] = float("nan")
    with pytest.raises(CheckpointError, match="NaN"):
        loads_field(dumps_field(field))


def test_missing_and_unwritable_files(field, tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing\.safetensors: cannot read"):
        load_field(tmp_path / "nothing.safetensors")
    with pytest.raises(CheckpointError, match="cannot write"):
        save_field(tmp_path / "no" / "field.safetensors", field)


def test_a_failed_write_leaves_the_old_file(field, tmp_path, monkeypatch):
    path = tmp_path / "field.safetensors"
    save_field(path, field)
    old = path.read_bytes()

    def fail(*_args, **_kwargs):
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(CheckpointError, match="disk full"):
        save_field(path, dataclasses_replaced(field))
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def dataclasses_replaced(field):
    description = dataclasses.replace(field.description, stamp_ns=1)
    return NeuralField(field.model, field.config, description)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_volumes_parts_are_the_field_through_it_as_safetensors_has_it(dtype):
    array = np.random.default_rng(1).integers(0, 250, (5, 6, 7)).astype(dtype)
    volume = Volume.from_array(array, (28e-6, 14e-6, 14e-6), intensity_scale="log", stamp_ns=7)
    field = InterpolatedField(volume)
    parts = volume_parts(volume)
    whole = b"".join(parts)
    assert whole == save_numpy({"voxels": array}, write_header(field.description, None))
    assert whole == dumps_field(field)
    assert field_hash(*parts) == field_hash(whole)
    assert np.shares_memory(np.asarray(parts[1]), volume.array)
    np.testing.assert_array_equal(loads_field(whole).volume.array, array)
