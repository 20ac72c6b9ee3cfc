"""Cost against size: a fit to equal PSNR and the queries of a whole lattice, with memory, each in its own process."""

from __future__ import annotations

import dataclasses
import multiprocessing
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from octn_ros.evaluation.speed_curves import Yardstick, all_bscans, field_psnr
from octn_ros.field import NeuralField
from octn_ros.training import FitConfig, fit
from octn_ros.training.warm_up import warm_up
from octn_ros.volume import Volume, VolumeGeometry

_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class SizeCost:
    """What a volume costs.

    Attributes:
        fit_s: from the arrival of the array to a field that has answered, compiling left out.
        steps: gradient steps of the fit.
        noisy_db: PSNR against the measured voxels, all of them.
        truth_db: against the truth, all voxels.
        lattice_s: all voxels asked for once.
        table_gb: the field's parameters.
        peak_gb: the greatest resident memory of the process up to the answer, libraries and the array included.
        backend: what answered.
    """

    fit_s: float
    steps: int
    noisy_db: float
    truth_db: float
    lattice_s: float
    table_gb: float
    peak_gb: float
    backend: str


def measure_size(against: Yardstick, config: FitConfig, device: str, threads: int) -> SizeCost:
    """Fit a phantom's volume in a process of its own and measure what it costs.

    Args:
        against: the phantom.
        config: of the fit, with the PSNR that ends it.
        device: where it is fitted.
        threads: that torch may use.

    Raises:
        BrokenProcessPool: the process died, of memory most likely.
    """
    with tempfile.TemporaryDirectory(prefix="octn-speed-") as folder:
        place = Path(folder)
        np.save(place / "volume.npy", against.phantom.volume.array)
        np.save(place / "truth.npy", against.phantom.truth.array)
        # Spawned, not forked: a copy of this process would begin with its memory.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(_measure, place, against.phantom.volume.geometry, config, device, threads).result()


def _measure(place: Path, geometry: VolumeGeometry, config: FitConfig, device: str, threads: int) -> SizeCost:
    torch.set_num_threads(threads)
    warm_up(config, device)
    array = np.load(place / "volume.npy")
    began = time.perf_counter()
    volume = Volume(array, geometry, (0.0, 255.0), "log")
    result = fit(volume, config, device=device)
    centre = torch.zeros(1, device=device)
    float(result.field.lattice(centre, centre, centre))
    fit_s = time.perf_counter() - began
    peak_gb = _peak_gb(device)
    lattice_s = time_lattice(result.field)
    truth = Volume(np.load(place / "truth.npy", mmap_mode="r"), geometry, (0.0, 1.0), "log")
    noisy_db, truth_db = field_psnr(result.field, (volume, truth), all_bscans(volume))
    table_gb = sum(p.numel() * p.element_size() for p in result.field.model.parameters()) / 1e9
    return SizeCost(fit_s, result.steps, noisy_db, truth_db, lattice_s, table_gb, peak_gb, result.field.backend)


def time_lattice(field: NeuralField, bscans: int = 0) -> float:
    """Return the seconds in which a field answers at all voxels of the first `bscans` B-scans, of all for 0."""
    bscan, axial, lateral = (torch.linspace(-1.0, 1.0, n, device=field.device) for n in field.geometry.shape)
    asked = bscan[:bscans] if bscans else bscan
    # In slabs, as queries ask: the answers of a large volume need not be held at once.
    began = time.perf_counter()
    for part in asked.split(32):
        answer = field.lattice(lateral, axial, part)
    float(answer[-1, -1, -1])
    return time.perf_counter() - began


def to_target(config: FitConfig, target_db: float) -> FitConfig:
    """Return the configuration of a fit that ends at a PSNR against the measured voxels."""
    return dataclasses.replace(config, target_psnr_db=target_db)


def _peak_gb(device: str) -> float:
    """Return the greatest memory so far: of the process, or of the device where that is a GPU and holds more."""
    used = 0.0
    if device.startswith("cuda"):
        used = torch.cuda.max_memory_allocated(device) / 1e9
    if _STATUS.is_file():
        # Unlike getrusage's, this figure begins anew with a program that another one starts.
        line = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
        return max(used, int(line.split()[1]) * 1024 / 1e9)
    unit = 1 if sys.platform == "darwin" else 1024
    return max(used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9)
