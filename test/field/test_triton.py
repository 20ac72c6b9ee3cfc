"""The Triton kernels: interpreted on the CPU, compiled for GPUs that need not be there, and run where one is."""

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig, NeuralModel
from octn_ros.field.backend import make_evaluator, make_forward
from octn_ros.training import PRESETS, ResidentVoxels, VoxelSampler
from octn_ros.training.point_trainer import PointTrainer
from octn_ros.volume import Volume

CASES = Path(__file__).with_name("triton_cases.py")
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed; pip install triton (Linux)"
)
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is there to run kernels on")
# What a program may have of a GeForce's shared memory without asking for more at launch.
SHARED_BYTES = 48 * 1024
INTEGERS = {
    "count", "axials", "laterals", "inputs", "more_layers", "levels", "point_stride", "feature_stride"
}  # fmt: skip
POINTERS = {"factor": "*i32", "mask": "*i32", "first_row": "*i64"}


def run_cases(*more, **environment):
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--timeout=500", str(CASES), *more]
    options = {"capture_output": True, "text": True, "timeout": 550, "cwd": CASES.parents[2]}
    run = subprocess.run(command, env=os.environ | environment, check=False, **options)
    assert run.returncode == 0, run.stdout + run.stderr
    assert " passed" in run.stdout
    assert "skipped" not in run.stdout


@needs_triton
@pytest.mark.timeout(600)  # it waits for a process that starts torch, on machines with other work
@pytest.mark.parametrize(
    "chosen",
    [
        pytest.param(("-k", "not (fit_by_triton or either_back_end)"), id="all but the longest two"),
        pytest.param((), id="every case", marks=pytest.mark.slow),
    ],
)
def test_kernels_equal_the_reference_through_the_interpreter(chosen):
    run_cases(*chosen, TRITON_INTERPRET="1", CUDA_VISIBLE_DEVICES="")


@needs_triton
@needs_cuda
@pytest.mark.timeout(600)
def test_kernels_equal_the_reference_on_the_gpu():
    run_cases(TRITON_INTERPRET="0")


def compiled(kernel, constants, launch, capability):
    from triton import compile as build
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    kinds = {name: "i32" if name in INTEGERS else POINTERS.get(name, "*fp32") for name in kernel.arg_names}
    signature = kinds | dict.fromkeys(constants, "constexpr")
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants)
    return build(source, target=GPUTarget("cuda", capability, 32), options=launch)


@needs_triton
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "capability",
    [80, *(pytest.param(other, marks=pytest.mark.slow) for other in (75, 90, 120))],
    ids=lambda capability: f"sm_{capability}",
)
def test_kernels_compile_for_gpus_and_fit_on_the_chip(capability, monkeypatch, tmp_path):
    """Interpreted kernels may use what the compiler refuses, and more memory than a chip has."""
    from octn_ros.field.cuda import encode_kernels, encoding, evaluator, fused_kernel

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    for network in (NetworkConfig(3, 128), NetworkConfig(1, 32, activation="softplus")):
        grid = HashGridConfig(levels=2, features=3, log2_table_size=8, interpolation="smoothstep")
        evaluated = evaluator.TritonEvaluator(NeuralModel(NeuralFieldConfig(grid, network), (9, 9, 9)))
        constants = evaluated.constants | {"precision": "tf32x3" if capability >= 80 else "ieee", "lattice": True}
        binary = compiled(fused_kernel.fused_kernel, constants, evaluator.LAUNCH, capability)
        assert len(binary.asm["cubin"]) > 1000
        assert binary.metadata.shared <= SHARED_BYTES
    constants = encoding.TritonEncoding(NeuralModel(NeuralFieldConfig(grid, network), (9, 9, 9)).grid).constants
    for name in ("encode_kernel", "table_gradient_kernel", "point_gradient_kernel"):
        binary = compiled(getattr(encode_kernels, name), constants, encoding.LAUNCH, capability)
        assert binary.metadata.shared <= SHARED_BYTES
        atomic = "atom.global" in binary.asm["ptx"] or "red.global" in binary.asm["ptx"]
        assert atomic == (name == "table_gradient_kernel")


def paper_trainer(backend):
    volume = Volume.from_array(np.random.default_rng(0).random((64, 128, 128), np.float32), (1e-5, 1e-5, 1e-5))
    voxels = ResidentVoxels(volume, torch.device("cuda"))
    config = PRESETS["paper"]
    model = NeuralModel(config.field, volume.geometry.shape).cuda()
    return model, PointTrainer(model, VoxelSampler(voxels, 0), config.batch, make_forward(model, backend))


def seconds(act):
    act()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(5):
        act()
    torch.cuda.synchronize()
    return time.perf_counter() - start


@needs_triton
@needs_cuda
def test_no_step_of_a_fit_waits_for_the_gpu():
    _, trainer = paper_trainer("triton")
    trainer.step(1e-2, 0.2, lambda: False)
    torch.cuda.set_sync_debug_mode("error")
    try:
        trainer.step(1e-2, 0.2, lambda: False)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@needs_triton
@needs_cuda
@pytest.mark.timeout(600)
def test_kernels_outrun_the_reference_on_the_gpu():
    """At least twofold for a step of the preset `paper` and for a lattice; figures are `octn bench speed`'s."""
    (model, fast), (_, plain) = paper_trainer("triton"), paper_trainer("torch")
    steps = [seconds(lambda trainer=trainer: trainer.step(1e-2, 0.2, lambda: False)) for trainer in (fast, plain)]
    assert steps[0] * 2 < steps[1]
    evaluator, axis = make_evaluator(model, "triton"), torch.linspace(-1, 1, 128, device="cuda")
    points = torch.cartesian_prod(axis, axis, axis)
    with torch.no_grad():
        lattices = [
            seconds(lambda: evaluator.lattice(axis, axis, axis)),
            seconds(lambda: [model(chunk) for chunk in points.split(1 << 17)]),
        ]
    assert lattices[0] * 2 < lattices[1]
