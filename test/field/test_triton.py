"""The Triton kernels: interpreted on the CPU, compiled for GPUs that need not be there, and run where one is."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

CASES = Path(__file__).with_name("triton_cases.py")
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton is not installed; pip install triton (Linux)"
)


def run_cases(path, **environment):
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--timeout=500", str(path)]
    options = {"capture_output": True, "text": True, "timeout": 550, "cwd": CASES.parents[2]}
    run = subprocess.run(command, env=os.environ | environment, check=False, **options)
    assert run.returncode == 0, run.stdout + run.stderr
    assert " passed" in run.stdout
    return run.stdout


@needs_triton
@pytest.mark.timeout(600)  # it waits for a process that starts torch, on machines with other work
def test_kernels_equal_the_reference_through_the_interpreter():
    assert "skipped" not in run_cases(CASES, TRITON_INTERPRET="1", CUDA_VISIBLE_DEVICES="")


@needs_triton
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is there to run the kernels on")
@pytest.mark.timeout(600)
def test_kernels_equal_the_reference_on_the_gpu():
    run_cases(CASES, TRITON_INTERPRET="0")
