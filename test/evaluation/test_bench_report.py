"""The frame of the benchmarks: cells, tables, JSON, files, environment, registry."""

import json
import math
import subprocess

import pytest

from octn_ros.commands.bench import BENCHMARK_NAMES
from octn_ros.errors import ConfigurationError
from octn_ros.evaluation.benchmark import BenchmarkResult, Column
from octn_ros.evaluation.environment import environment, git_commit
from octn_ros.evaluation.registry import MODULES, benchmark
from octn_ros.evaluation.report import markdown, result_to_plain, write_report

COLUMNS = (Column("method", "method"), Column("hit_rate", "hits %", "{:.1f}", 100.0), Column("max_um", "max", "{:.2f}"))


def result():
    return BenchmarkResult(
        name="example",
        title="an example",
        rows=[{"method": "ours", "hit_rate": 0.987, "max_um": math.nan}, {"method": "other", "hit_rate": None}],
        columns=COLUMNS,
        paper=[{"method": "theirs", "hit_rate": 0.328, "source": "fig. 4"}],
        deviations=["Nothing is the same."],
        notes=["More is better."],
        configuration={"bench": {"side_m": 3e-3, "names": ("a", "b")}},
        seeds={"speckle": 7},
        seconds=1.5,
        pictures={"example.png": b"\x89PNG"},
    )


def test_cells_are_scaled_and_missing_ones_are_dashes():
    percent, plain = COLUMNS[1], COLUMNS[0]
    assert percent.text({"hit_rate": 0.5}) == "50.0"
    assert percent.text({"hit_rate": math.nan}) == percent.text({}) == "-"
    assert plain.text({"method": "newton"}) == "newton"
    assert plain.text({"method": 16}) == "16"


def test_the_report_names_everything_a_reader_needs():
    text = markdown(result(), environment("cpu"))
    assert "| ours | 98.7 | - |" in text
    assert "| theirs | 32.8 | fig. 4 |" in text
    for words in ("Nothing is the same.", "More is better.", "cores", "commit", '"side_m": 0.003', '"speckle": 7'):
        assert words in text
    assert "![example.png](example.png)" in text


def test_json_holds_no_nan_and_every_setting():
    surroundings = environment("cpu")
    plain = json.loads(json.dumps(result_to_plain(result(), surroundings), allow_nan=False))
    assert plain["rows"][0] == {"method": "ours", "hit_rate": 0.987, "max_um": None}
    assert plain["configuration"]["bench"]["names"] == ["a", "b"]
    assert plain["seeds"] == {"speckle": 7}
    assert plain["versions"]["torch"]
    assert plain["hardware"]["cores"] >= 1
    assert {"commit", "date", "deviations", "paper"} <= set(plain)


def test_report_files(tmp_path):
    written = write_report(tmp_path, result(), environment("cpu"))
    assert [path.name for path in written] == ["example.json", "example.md", "example.png"]
    assert json.loads((tmp_path / "example.json").read_text())["benchmark"] == "example"
    with pytest.raises(OSError, match="No such file"):
        write_report(tmp_path / "missing", result(), environment("cpu"))


def test_the_commit_tells_a_dirty_checkout(tmp_path):
    def git(*arguments):
        identity = ("-c", "user.name=n", "-c", "user.email=e@example.org")
        subprocess.run(["git", "-C", tmp_path, *identity, *arguments], check=True, capture_output=True)

    assert git_commit(tmp_path) is None
    git("init")
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-m", "first")
    commit = git_commit(tmp_path)
    assert len(commit) == 40
    (tmp_path / "file").write_text("two")
    assert git_commit(tmp_path) == f"{commit}-dirty"


def test_code_is_told_by_its_files(tmp_path, monkeypatch):
    """A changed or a renamed source file is other code; a node or a cache file changes no figure."""
    from octn_ros.evaluation import environment as module

    for name in ("octn_ros/field/grid.py", "octn_ros/nodes/trainer.py", "octn_ros/__init__.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("one")
    monkeypatch.setattr(module.octn_ros, "__file__", str(tmp_path / "octn_ros" / "__init__.py"))

    def hashed():
        return module.code_hash.__wrapped__()

    first = hashed()
    (tmp_path / "octn_ros/nodes/trainer.py").write_text("two")
    (tmp_path / "octn_ros/field/grid.nbi").write_text("two")
    assert hashed() == first
    (tmp_path / "octn_ros/field/grid.py").write_text("two")
    second = hashed()
    (tmp_path / "octn_ros/field/grid.py").rename(tmp_path / "octn_ros/field/cells.py")
    assert len({first, second, hashed()}) == 3


def test_the_benchmarks_named_are_the_benchmarks_there_are():
    assert set(BENCHMARK_NAMES) == set(MODULES)
    for name in MODULES:
        assert callable(benchmark(name))
    with pytest.raises(ConfigurationError, match="expected one of"):
        benchmark("magic")
