"""Interpolated fields, old files, and headers that lie."""

import json
import os
import stat
import subprocess
import sys

import numpy as np
import pytest
import safetensors.numpy
import torch
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
    load_field,
    loads_field,
    save_field,
)
from octn_ros.volume import Volume

SPACING = (28e-6, 14.59e-6, 14e-6)
CONFIG = NeuralFieldConfig(
    HashGridConfig(levels=2, features=2, log2_table_size=8, base_resolution=4, interpolation="smoothstep"),
    NetworkConfig(1, 8, "softplus"),
)


def volume(dtype=np.uint8, shape=(4, 5, 6)):
    array = np.random.default_rng(3).integers(0, 250, shape).astype(dtype)
    return Volume.from_array(array, SPACING, origin_m=(1e-3, 2e-3, 3e-3), intensity_range=(10.0, 200.0), stamp_ns=9)


def neural():
    torch.manual_seed(0)
    description = FieldDescription.of_volume(volume(), "neural", {"psnr_db": 31.5})
    return NeuralField(NeuralModel(CONFIG, (4, 5, 6)), CONFIG, description)


def taken_apart(data):
    length = int.from_bytes(data[:8], "little")
    outer = json.loads(data[8 : 8 + length])
    return outer, json.loads(outer["__metadata__"]["octn_field"]), data[8 + length :]


def put_together(outer, header, content):
    outer["__metadata__"]["octn_field"] = header if isinstance(header, str) else json.dumps(header)
    text = json.dumps(outer).encode()
    return len(text).to_bytes(8, "little") + text + content


def scattered():
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("order", ["trilinear", "cubic"])
def test_an_interpolated_field_keeps_its_voxels_and_their_type(dtype, order, tmp_path):
    field = InterpolatedField(volume(dtype), order=order)
    save_field(tmp_path / "field", field)
    back = load_field(tmp_path / "field")
    assert isinstance(back, InterpolatedField)
    assert back.description == field.description
    assert back.description.order == order
    assert back.volume.array.dtype == dtype
    np.testing.assert_array_equal(back.volume.array, field.volume.array)
    assert torch.equal(back.evaluate(scattered()), field.evaluate(scattered()))
    assert dumps_field(back) == dumps_field(field)
    assert dumps_field(field, half=True) == dumps_field(field)


def test_a_smooth_neural_field_comes_back_smooth():
    back = loads_field(dumps_field(neural()))
    assert back.config == CONFIG
    assert torch.equal(back.evaluate(scattered()), neural().evaluate(scattered()))


def test_files_of_version_1_still_load():
    outer, header, content = taken_apart(dumps_field(neural()))
    for key in ("kind", "order"):
        header.pop(key)
    header.update(version=1, dtype="float32")
    for part, keys in (("grid", ["interpolation"]), ("network", ["activation"])):
        for key in keys:
            header["config"][part].pop(key)
    header["config"] = {part: header["config"][part] for part in ("grid", "network")}
    back = loads_field(put_together(outer, header, content))
    assert (back.kind, back.config.grid.interpolation, back.config.network.activation) == ("neural", "linear", "relu")
    assert back.config.grid.levels == CONFIG.grid.levels
    assert torch.equal(back.model.grid.table, neural().model.grid.table)


def test_a_third_kind_is_refused():
    with pytest.raises(CheckpointError, match="expected a neural or an interpolated field to store, got object"):
        dumps_field(object())


def test_a_training_record_that_json_cannot_hold_is_refused():
    field = neural()
    field.description.training["odd"] = object()
    with pytest.raises(CheckpointError, match="training record"):
        dumps_field(field)


def test_files_get_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    save_field(tmp_path / "field", neural())
    assert stat.S_IMODE((tmp_path / "field").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("path", ["/dev/zero", "/", "/dev/null"])
def test_places_that_are_no_files_are_refused(path):
    with pytest.raises(CheckpointError, match=r"cannot read|truncated or foreign"):
        load_field(path)


HUGE = 10**30
LIES = {
    "kind": lambda o, h: h.update(kind="telepathic"),
    "kind of another type": lambda o, h: h.update(kind=["neural"]),
    "interpolated without voxels": lambda o, h: h.update(kind="interpolated", order="cubic"),
    "version as text": lambda o, h: h.update(version="2"),
    "version as truth": lambda o, h: h.update(version=True),
    "version zero": lambda o, h: h.update(version=0),
    "huge shape": lambda o, h: h["geometry"].update(shape=[HUGE, HUGE, HUGE]),
    "large shape": lambda o, h: h["geometry"].update(shape=[2**20, 2**20, 2**20]),
    "fractional shape": lambda o, h: h["geometry"].update(shape=[4.0, 5, 6]),
    "flat shape": lambda o, h: h["geometry"].update(shape=[4, 5]),
    "NaN spacing": lambda o, h: h["geometry"].update(spacing_m=[float("nan")] * 3),
    "text spacing": lambda o, h: h["geometry"].update(spacing_m=["1", "1", "1"]),
    "infinite origin": lambda o, h: h["geometry"].update(origin_m=[float("inf"), 0, 0]),
    "frame": lambda o, h: h["geometry"].update(frame=7),
    "geometry as list": lambda o, h: h.update(geometry=[4, 5, 6]),
    "reversed range": lambda o, h: h.update(intensity_range=[1, 0]),
    "NaN range": lambda o, h: h.update(intensity_range=[0, float("nan")]),
    "long range": lambda o, h: h.update(intensity_range=[0, 1, 2]),
    "scale": lambda o, h: h.update(intensity_scale="loud"),
    "stamp": lambda o, h: h.update(stamp_ns=-1),
    "huge stamp": lambda o, h: h.update(stamp_ns=2**70),
    "training": lambda o, h: h.update(training=[1]),
    "software": lambda o, h: h.update(software_version=None),
    "config as list": lambda o, h: h.update(config=[]),
    "grid as number": lambda o, h: h["config"].update(grid=5),
    "levels": lambda o, h: h["config"]["grid"].update(levels=32, log2_table_size=24, features=16),
    "NaN ratio": lambda o, h: h["config"]["grid"].update(finest_ratio=float("nan")),
    "interpolation": lambda o, h: h["config"]["grid"].update(interpolation="magic"),
    "network": lambda o, h: h["config"]["network"].update(hidden_layers=8, neurons=1024),
    "tensor shape": lambda o, h: o["grid.table"].update(shape=[HUGE, 2]),
    "tensor shape by product": lambda o, h: o["grid.table"].update(shape=o["grid.table"]["shape"][::-1]),
    "tensor type": lambda o, h: o["grid.table"].update(dtype="BOOL"),
    "tensor type of another size": lambda o, h: o["grid.table"].update(dtype="F16"),
    "overlap": lambda o, h: o["network.output.bias"].update(data_offsets=o["network.hidden.0.bias"]["data_offsets"]),
    "negative offsets": lambda o, h: o["grid.table"].update(data_offsets=[-8, 0]),
    "offsets beyond the end": lambda o, h: o["grid.table"].update(data_offsets=[2**60, 2**61]),
    "one offset": lambda o, h: o["grid.table"].update(data_offsets=[0]),
    "no offsets": lambda o, h: o["grid.table"].pop("data_offsets"),
    "a tensor more": lambda o, h: o.update(more={"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}),
    "a tensor less": lambda o, h: o.pop("network.output.bias"),
    "tensor as list": lambda o, h: o.update({"grid.table": []}),
}


@pytest.mark.parametrize("lie", LIES)
def test_headers_that_lie_are_refused(lie):
    outer, header, content = taken_apart(dumps_field(neural()))
    LIES[lie](outer, header)
    with pytest.raises(CheckpointError):
        loads_field(put_together(outer, header, content))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 5_000 + "1" + "}" * 5_000, "1" * 10_000, "null", "3", '"x"'])
def test_headers_that_are_deep_or_not_objects_are_refused(text):
    outer, _, content = taken_apart(dumps_field(neural()))
    with pytest.raises(CheckpointError):
        loads_field(put_together(outer, text, content))
    with pytest.raises(CheckpointError):
        loads_field(len(text).to_bytes(8, "little") + text.encode() + content)


def test_voxels_of_a_type_we_do_not_keep_or_without_tissue_are_refused():
    outer, header, _ = taken_apart(dumps_field(InterpolatedField(volume())))
    for voxels in (np.zeros((4, 5, 6), np.uint8), np.full((4, 5, 6), np.nan, np.float32), np.ones((4, 5, 6))):
        data = safetensors.numpy.save({"voxels": voxels}, {"octn_field": json.dumps(header)})
        with pytest.raises(CheckpointError):
            loads_field(data)
    assert outer["voxels"]["dtype"] == "U8"


def test_appended_bytes_are_refused():
    with pytest.raises(CheckpointError, match=r"padded"):
        loads_field(dumps_field(neural()) + b"more")


def test_a_header_without_our_metadata_is_foreign():
    with pytest.raises(CheckpointError, match="expected a field of this package"):
        loads_field(save({"weight": torch.zeros(3)}, {"format": "pt"}))


HOSTILE = """
import json, resource, sys, tracemalloc
import torch
from octn_ros.errors import CheckpointError
from octn_ros.field import load_field, loads_field
base = json.loads(sys.argv[1])
def refused(shape, count, config):
    header = dict(base, geometry=dict(base["geometry"], shape=shape), config=config)
    outer = {"__metadata__": {"octn_field": json.dumps(header)},
             "grid.table": {"dtype": "F32", "shape": [count, 2], "data_offsets": [0, 8 * count]}}
    text = json.dumps(outer).encode()
    data = len(text).to_bytes(8, "little") + text + bytes(64)
    try:
        loads_field(data)
    except CheckpointError:
        return
    raise SystemExit("accepted a hostile header")
torch.zeros(1)
used = int(open("/proc/self/statm").read().split()[0]) * 4096
resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20), used + (256 << 20)))
tracemalloc.start()
big = dict(base["config"], grid=dict(base["config"]["grid"], levels=32, log2_table_size=24, features=16))
for shape in ([1 << 20] * 3, [512, 1024, 1024], [2, 2, 2]):
    for count in (1 << 24, 1 << 40):
        refused(shape, count, big)
        refused(shape, count, base["config"])
for length in (2**63, 2**40, 1 << 29):
    try:
        loads_field(length.to_bytes(8, "little") + b"{" * 64)
    except CheckpointError:
        continue
    raise SystemExit("accepted a hostile length")
with open(sys.argv[2], "wb") as file:
    file.write((1 << 29).to_bytes(8, "little"))
    file.truncate(1 << 30)
try:
    load_field(sys.argv[2])
except CheckpointError:
    print(tracemalloc.get_traced_memory()[1])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory as Linux has them")
def test_hostile_headers_allocate_nothing_large(tmp_path):
    _, header, _ = taken_apart(dumps_field(neural()))
    arguments = [sys.executable, "-c", HOSTILE, json.dumps(header), str(tmp_path / "sparse")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.run(arguments, capture_output=True, text=True, timeout=100, env=environment)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) < 8 << 20


def damaged(rng, data):
    """Return a copy with one thing wrong: cut, bits flipped, a stretch zeroed, doubled, or bytes of the header set."""
    data = bytearray(data)
    kind = rng.integers(6)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    header = 8 + int.from_bytes(data[:8], "little")
    for _ in range(rng.integers(1, 4)):
        where = int(rng.integers(header if kind in (1, 2) else len(data)))
        if kind in (1, 3):
            data[where] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            data[where] = int(rng.choice(list(b'0123456789{}[]",:-eNn\x00\xff')))
        elif kind == 4:
            data[where : where + 64] = bytes(min(64, len(data) - where))
        else:
            data[where:where] = data[where : where + 32]
    return bytes(data)


def survive(count, seed):
    rng = np.random.default_rng(seed)
    files = [
        dumps_field(neural()),
        dumps_field(neural(), half=True),
        dumps_field(InterpolatedField(volume(np.uint16))),
        dumps_field(InterpolatedField(volume(np.float32), order="cubic")),
    ]
    refused = 0
    for turn in range(count):
        try:
            field = loads_field(damaged(rng, files[turn % len(files)]))
        except CheckpointError:
            refused += 1
        else:
            # Damage to a parameter or a voxel may leave a field; then it must be one that answers.
            assert bool(torch.isfinite(field.evaluate(scattered()[:4])).all())
    return refused


def test_damaged_files_are_refused_or_answer():
    assert survive(400, seed=0) > 200


@pytest.mark.slow
def test_thousands_of_damaged_files_are_refused_or_answer():
    assert survive(6000, seed=1) > 3000
