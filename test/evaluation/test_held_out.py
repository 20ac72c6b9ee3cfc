"""Where a protocol says held out, no figure comes from what a field was fitted to, and no field from what is held out.

Two scans that differ only in the B-scans that are held out must give the same representations: figures of fitted
B-scans to the last bit the same, figures of held-out ones others, and worse on the whole where these were spoilt.
"""

import dataclasses

import numpy as np
import pytest

from octn_ros.evaluation import compare, sparse
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.compare_config import CompareBenchConfig
from octn_ros.evaluation.scans import BenchScan, ScanSource
from octn_ros.evaluation.sparse_config import SparseBenchConfig
from octn_ros.simulation import make_phantom, named_phantom

FACTOR = 4
PROTOCOLS = {
    "sparse": (
        sparse,
        SparseBenchConfig(factors=(FACTOR,), steps=20),
        ("sigma_voxels", "kept"),
        tuple(f"{method}_{figure}" for method in sparse.METHODS for figure in ("psnr_db", "ssim")),
    ),
    "compare": (
        compare,
        CompareBenchConfig(factor=FACTOR, presets=("fast", "sparse"), budgets=("samples",), samples=1 << 12),
        ("fitted_psnr_db", "fitted_ssim", "samples", "steps", "parameters"),
        ("held_out_psnr_db", "held_out_ssim"),
    ),
}


def rows_of(volume, module, config, monkeypatch):
    source = ScanSource("scan", lambda: BenchScan("scan", volume))
    monkeypatch.setattr(module, "scan_sources", lambda *_: [source])
    return module.run(BenchmarkRequest(device="cpu"), config).rows


@pytest.mark.parametrize("protocol", sorted(PROTOCOLS))
def test_held_out_bscans_decide_held_out_figures_alone(protocol, monkeypatch):
    module, config, of_fitted, of_held_out = PROTOCOLS[protocol]
    volume = make_phantom(named_phantom("wavy-13dB-averaged", shape=(17, 48, 16))).volume
    held_out = np.arange(17) % FACTOR != 0
    array = volume.array.copy()
    array[held_out] = array.max() - array[held_out]
    spoilt = dataclasses.replace(volume, array=array)
    rows, others = (rows_of(each, module, config, monkeypatch) for each in (volume, spoilt))
    assert len(rows) == len(others) > 0
    for row, other in zip(rows, others, strict=True):
        assert {key: row[key] for key in of_fitted} == {key: other[key] for key in of_fitted}
        assert all(abs(row[key] - other[key]) > 1e-3 for key in of_held_out)
    for key in of_held_out:
        assert np.mean([row[key] - other[key] for row, other in zip(rows, others, strict=True)]) > 0.01
