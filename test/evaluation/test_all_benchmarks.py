"""`octn bench all`: one report, failures of one benchmark, and what an earlier run has finished."""

import json
import sys
import types

import pytest

from octn_ros.errors import QueryError, VolumeError
from octn_ros.evaluation import all_benchmarks, registry
from octn_ros.evaluation.all_benchmarks import AllBenchConfig
from octn_ros.evaluation.benchmark import BenchmarkRequest, BenchmarkResult, Column
from octn_ros.evaluation.report import markdown
from octn_ros.simulation import make_phantom, named_phantom
from octn_ros.volume import save_volume

NAMES = AllBenchConfig(names=("sparse", "raster"))


@pytest.fixture
def instant(monkeypatch):
    """Benchmarks that take no time in the places of sparse and raster; returns requests, and errors to raise."""
    requests, errors = [], {}

    def run_as(name):
        def run(request):
            requests.append((name, request))
            request.progress("scans", 0.5, "half")
            if name in errors:
                raise errors[name]
            rows, columns = [{"volume": "flat", "x": 0.5}], [Column("volume", "scan"), Column("x", "X")]
            return BenchmarkResult(
                name, f"{name} title", rows, columns, [], ["All."], [], {"bench": 1}, {}, 2.0, {f"{name}-a.png": b"p"}
            )

        return run

    for name in NAMES.names:
        module = types.ModuleType(f"instant_{name}")
        module.run = run_as(name)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(registry.MODULES, name, module.__name__)
    return requests, errors


def states(result):
    return {row["benchmark"]: row["state"] for row in result.rows}


def test_one_report_of_all(instant, tmp_path):
    told = []
    request = BenchmarkRequest(device="cpu", quick=True, output=tmp_path, progress=lambda *what: told.append(what))
    result = all_benchmarks.run(request, NAMES)
    assert states(result) == {"sparse": "measured", "raster": "measured"}
    assert ("1/2 sparse: scans", 0.5, "half") in told
    assert all(request.quick and request.output == tmp_path for _, request in instant[0])
    assert json.loads((tmp_path / "sparse.json").read_text())["rows"] == [{"volume": "flat", "x": 0.5}]
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# octn bench")
    assert "| [sparse](#sparse) | measured | 2 | 1 | sparse title |" in text
    assert '<a id="raster"></a>' in text
    assert "## octn bench raster: raster title" in text
    assert "### Configuration" in text
    assert "| flat | 0.5 |" in text
    assert "![sparse-a.png](sparse-a.png)" in text
    assert text.count("\n# ") == 0
    assert "paper's figures |" not in markdown(result, {**json.loads((tmp_path / "sparse.json").read_text())})


@pytest.mark.parametrize(("error", "words"), [(QueryError("no surface"), "no surface"), (KeyError("b"), "KeyError")])
def test_a_benchmark_that_fails_is_told_and_tried_again(instant, tmp_path, error, words):
    requests, errors = instant
    errors["sparse"] = error
    request = BenchmarkRequest(device="cpu", output=tmp_path)
    result = all_benchmarks.run(request, NAMES)
    assert states(result) == {"sparse": "failed", "raster": "measured"}
    assert any(note.startswith("sparse failed") and words in note for note in result.notes)
    text = (tmp_path / "report.md").read_text()
    assert "It failed; see above." in text
    assert words in text
    errors.clear()
    requests.clear()
    again = all_benchmarks.run(request, NAMES)
    assert [name for name, _ in requests] == ["sparse"]
    assert states(again)["raster"].startswith("measured 20")
    assert "It failed" not in (tmp_path / "report.md").read_text()


def test_only_the_same_run_is_taken_as_done(instant, tmp_path, monkeypatch):
    """Another size, another device, other code or a picture that is gone: the benchmark is run again."""
    requests, _ = instant
    one = AllBenchConfig(names=("sparse",))

    def count(**request):
        requests.clear()
        all_benchmarks.run(BenchmarkRequest(output=tmp_path, **request), one)
        return len(requests)

    assert [count(device="cpu"), count(device="cpu")] == [1, 0]
    assert count(device="cpu", quick=True) == 1
    assert count(device="cpu") == 1
    assert count(device="cpu", spacing_um=(1.0, 2.0, 3.0)) == 1
    (tmp_path / "sparse-a.png").unlink()
    assert count(device="cpu", spacing_um=(1.0, 2.0, 3.0)) == 1
    (tmp_path / "sparse.json").write_text("rubbish")
    assert count(device="cpu", spacing_um=(1.0, 2.0, 3.0)) == 1
    monkeypatch.setattr(all_benchmarks, "code_hash", lambda: "other")
    assert count(device="cpu", spacing_um=(1.0, 2.0, 3.0)) == 1


def test_phantoms_alone_get_no_folder(instant, tmp_path):
    """A folder goes to those that can use it; an empty one is an error of the call."""
    scans = tmp_path / "scans"
    scans.mkdir()
    with pytest.raises(VolumeError, match="found none"):
        all_benchmarks.run(BenchmarkRequest(data=scans), NAMES)
    save_volume(scans / "a.nii.gz", make_phantom(named_phantom("flat-13dB-averaged", shape=(8, 64, 8))).volume)
    result = all_benchmarks.run(BenchmarkRequest(data=scans, device="cpu"), NAMES)
    assert {name: request.data for name, request in instant[0]} == {"sparse": scans, "raster": None}
    assert any("Measured on phantoms" in note and "raster" in note for note in result.notes)


def test_every_benchmark_takes_part():
    assert set(AllBenchConfig().names) == set(registry.MODULES) - {"all"}
    assert set(registry.PHANTOMS_ALONE) < set(registry.MODULES)
