"""The engine of the benchmarks: failures of one scan, what is kept, and the same figures by several processes."""

import dataclasses
import functools
import json
import math
import os

import pytest

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.evaluation import engine, kept_rows, sparse
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.engine import process_count, run_volumes
from octn_ros.evaluation.kept_rows import ScanResult
from octn_ros.evaluation.scans import BenchScan, ScanSource, scan_sources
from octn_ros.evaluation.sparse_config import SparseBenchConfig
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import save_volume

SETTINGS = {"steps": 3}
VOLUME = make_phantom(named_phantom("flat-13dB-averaged", shape=(8, 64, 8))).volume


def source(name, fingerprint=""):
    return ScanSource(name, lambda: BenchScan(name, VOLUME), fingerprint=fingerprint)


def broken(error):
    def load():
        raise error

    return ScanSource("broken", load)


def measure(scan, seen):
    seen.append(scan.name)
    return ScanResult([{"volume": scan.name, "psnr_db": math.inf, "n": 3}], {f"{scan.file_name}.png": b"\x89P"}, ["so"])


def run(sources, seen, output=None, settings=SETTINGS, **request):
    work = functools.partial(measure, seen=seen)
    return run_volumes(
        sources, work, BenchmarkRequest(output=output, **request), name="test", configuration=settings
    )  # fmt: skip


@pytest.mark.parametrize(
    ("error", "words"),
    [(VolumeError("no spacing"), "broken is left out: no spacing."), (KeyError("b"), "broken is left out: KeyError")],
)
def test_a_scan_that_fails_is_told_and_stops_nothing(error, words):
    seen, told = [], []
    request = {"progress": lambda *what: told.append(what)}
    result = run([source("a"), broken(error), source("c")], seen, **request)
    assert [row["volume"] for row in result.rows] == ["a", "c"]
    assert any(note.startswith(words) for note in result.notes)
    assert set(result.pictures) == {"a.png", "c.png"}
    assert told[-1][1] == 1.0


def test_what_is_done_is_not_done_again(tmp_path):
    """Only the same file by the same settings and the same code is taken as done; what failed is tried again."""
    seen = []
    first = run([source("a/b"), broken(VolumeError("no")), source("c")], seen, tmp_path, device="cpu")
    again = run([source("a/b"), source("broken"), source("c")], seen, tmp_path, device="cpu")
    assert seen == ["a/b", "c", "broken"]
    assert [row["volume"] for row in again.rows] == ["a/b", "broken", "c"]
    assert list(again.rows[::2]) == list(first.rows)
    assert again.pictures["a-b.png"] == b"\x89P"
    assert any("2 of 3 scans were measured by an earlier run" in note for note in again.notes)
    run([source("c", "another file")], seen, tmp_path, device="cpu")
    run([source("c")], seen, tmp_path, {"steps": 4}, device="cpu")
    run([source("c")], seen, tmp_path, device="cuda")
    assert seen[3:] == ["c", "c", "c"]


def test_other_code_measures_again(tmp_path, monkeypatch):
    seen = []
    run([source("a")], seen, tmp_path)
    monkeypatch.setattr(kept_rows, "code_hash", lambda: "other")
    run([source("a")], seen, tmp_path)
    assert seen == ["a", "a"]


def test_a_kept_file_that_is_damaged_is_measured_again(tmp_path):
    seen = []
    run([source("a")], seen, tmp_path)
    (kept,) = (tmp_path / "volumes" / "test").iterdir()
    kept.write_text(json.dumps({"rows": []})[:-3])
    assert run([source("a")], seen, tmp_path).rows[0]["psnr_db"] == math.inf
    assert seen == ["a", "a"]


def test_a_run_that_is_broken_off_keeps_what_it_had(tmp_path):
    seen = []
    with pytest.raises(KeyboardInterrupt):
        run([source("a"), broken(KeyboardInterrupt())], seen, tmp_path)
    run([source("a"), source("b")], seen, tmp_path)
    assert seen == ["a", "b"]


def test_a_file_that_changes_is_another(tmp_path):
    """A folder's scan is known by size and time of its file, a folder of images by those of all."""
    save_volume(tmp_path / "scan.nii.gz", VOLUME)
    request = BenchmarkRequest(data=tmp_path)
    (one,) = scan_sources(request, (), (8, 16, 8), 0)
    (same,) = scan_sources(request, (), (8, 16, 8), 0)
    os.utime(tmp_path / "scan.nii.gz", ns=(1, 1))
    (touched,) = scan_sources(request, (), (8, 16, 8), 0)
    (spaced,) = scan_sources(dataclasses.replace(request, spacing_um=(1.0, 2.0, 3.0)), (), (8, 16, 8), 0)
    assert one.fingerprint == same.fingerprint
    assert len({one.fingerprint, touched.fingerprint, spaced.fingerprint}) == 3


def test_how_many_side_by_side(tmp_path, monkeypatch):
    """Scans of a folder share the cores; phantoms, GPUs and machines without Dask take one after the other."""
    monkeypatch.setattr(engine, "cores", lambda: 8)
    monkeypatch.setattr(engine, "_memory_gigabytes", lambda: 20.0)
    monkeypatch.setattr(engine, "dask_is_there", lambda: True)
    folder = BenchmarkRequest(data=tmp_path, device="cpu")
    assert process_count(2, folder) == 2
    assert process_count(46, folder) == 3
    assert process_count(0, folder) == 1
    assert process_count(46, dataclasses.replace(folder, workers=5)) == 5
    assert process_count(46, dataclasses.replace(folder, device="cuda:0")) == 1
    assert process_count(46, BenchmarkRequest(device="cpu")) == 1
    monkeypatch.setattr(engine, "dask_is_there", lambda: False)
    assert process_count(46, folder) == 1
    with pytest.raises(ConfigurationError, match="expected 1 without Dask"):
        process_count(46, dataclasses.replace(folder, workers=5))


@pytest.mark.slow
def test_several_processes_give_the_same_figures(tmp_path):
    """Two workers of a local cluster and this process: the same rows, whatever is broken in the folder."""
    pytest.importorskip("distributed", reason="Dask is not installed")
    for number in range(2):
        phantom = make_phantom(named_phantom("wavy-13dB-averaged", seed=number, shape=(9, 48, 16)))
        save_volume(tmp_path / f"{number}.nii.gz", phantom.volume)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY rubbish")
    config = SparseBenchConfig(factors=(2,), steps=10)
    alone, shared = (
        sparse.run(BenchmarkRequest(data=tmp_path, device="cpu", workers=workers), config) for workers in (1, 2)
    )
    assert any("2 processes side by side" in note for note in shared.notes)
    assert sum("bad.npy is left out" in note for note in shared.notes) == 1
    assert [row["volume"] for row in shared.rows] == ["0.nii.gz", "1.nii.gz"]
    for one, two in zip(alone.rows, shared.rows, strict=True):
        assert set(one) == set(two)
        for key in set(one) - {"seconds", "volume"}:
            assert one[key] == pytest.approx(two[key], rel=1e-4, nan_ok=True), key
    assert set(alone.pictures) == set(shared.pictures)


@pytest.mark.slow
def test_a_worker_that_dies_fails_its_scan_alone():
    """Four scans and two workers, one of which is ended by the second scan, as for want of memory."""
    pytest.importorskip("distributed", reason="Dask is not installed")
    dying = ScanSource("dying", lambda: os._exit(1))
    names = ("a", "dying", "c", "d")
    sources = [dying if name == "dying" else ScanSource(name, functools.partial(str, name)) for name in names]
    # Functions of this file cannot be found by another process, a lambda goes there whole.
    work = lambda scan: ScanResult([{"volume": scan}])  # noqa: E731
    result = run_volumes(
        sources, work, BenchmarkRequest(device="cpu", workers=2), name="test", configuration=SETTINGS
    )  # fmt: skip
    assert [row["volume"] for row in result.rows] == ["a", "c", "d"]
    assert any(note.startswith("dying is left out: KilledWorker") for note in result.notes)


def test_a_cluster_that_cannot_be_used_is_said(monkeypatch):
    """No scheduler at the address, one without workers, and one whose workers run other code."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    from octn_ros.evaluation import side_by_side

    monkeypatch.setattr(side_by_side, "_CONNECT_S", 1)
    with pytest.raises(ConfigurationError, match="address of a running Dask scheduler, got 'nonsense://x'"):
        run([source("a")], [], scheduler="nonsense://x")
    with pytest.raises(ConfigurationError, match="address of a running Dask scheduler"):
        run([source("a")], [], scheduler="tcp://127.0.0.1:9")
    threads = {"processes": False, "threads_per_worker": 1, "dashboard_address": None, "worker_dashboard_address": None}
    with distributed.LocalCluster(n_workers=0, **threads) as cluster:
        with pytest.raises(ConfigurationError, match="start dask worker"):
            run([source("a")], [], scheduler=cluster.scheduler_address)
        cluster.scale(1)
        with distributed.Client(cluster, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=20)
        result = run([source("a"), source("b")], [], scheduler=cluster.scheduler_address)
        assert [row["volume"] for row in result.rows] == ["a", "b"]
        here = []
        monkeypatch.setattr(side_by_side, "code_hash", lambda: id(here))  # a worker has a copy
        with pytest.raises(ConfigurationError, match="have other code"):
            run([source("a")], [], scheduler=cluster.scheduler_address)
