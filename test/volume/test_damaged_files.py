"""Damaged and hostile files over all readers: an error that names the file, never a crash, a hang or a flood."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent / "damage.py"
MEMORY_BYTES = 2 * 10**9
SECONDS = 5


def read_damaged(folder, first, count, step, timeout_s):
    """Return what became of each file; fail with the file's name if the process did not survive it."""
    command = [sys.executable, str(SCRIPT), str(folder), str(first), str(count), str(step)]
    alone = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # threads' stacks count as memory
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False, env=alone)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"after {lines[-1:]}: code {done.returncode}\n{done.stderr[-3000:]}"
    return [{**file, **result} for file, result in zip(lines[::2], lines[1::2], strict=True)]


def check(results, count):
    assert len(results) == count
    assert max(result["peak_bytes"] for result in results) < MEMORY_BYTES
    slow = [result for result in results if result["cpu_s"] > SECONDS]
    assert not slow
    refused = sum(result["outcome"] == "refused" for result in results)
    assert refused > count / 3  # a flipped bit among the voxels does not show; most damage does


def test_a_sample_of_damaged_files(tmp_path):
    check(read_damaged(tmp_path, 0, 150, 1, timeout_s=110), 150)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_five_thousand_damaged_files(tmp_path):
    check(read_damaged(tmp_path, 0, 5000, 1, timeout_s=3500), 5000)
