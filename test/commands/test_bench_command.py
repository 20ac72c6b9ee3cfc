"""`octn bench`: JSON, table and report files of a benchmark that takes no time, and what it refuses."""

import json
import re
import sys
import types

import pytest

from octn_ros.cli import main


@pytest.fixture
def instant(monkeypatch):
    """A benchmark in the place of `raster`; returns the requests it was given."""
    from octn_ros.evaluation import registry
    from octn_ros.evaluation.benchmark import BenchmarkResult, Column

    requests = []

    def run(request):
        requests.append(request)
        request.progress("measuring", 0.5, "half")
        rows = [{"phantom": "flat", "hit_rate": 0.5}]
        columns = [Column("phantom", "phantom"), Column("hit_rate", "hits %", "{:.0f}", 100.0)]
        return BenchmarkResult(
            "raster", "a table", rows, columns, [], ["All differs."], [], {}, {}, 0.1, {"a.png": b"p"}
        )

    module = types.ModuleType("instant_benchmark")
    module.run = run
    monkeypatch.setitem(sys.modules, "instant_benchmark", module)
    monkeypatch.setitem(registry.MODULES, "raster", "instant_benchmark")
    return requests


def test_json_and_report(instant, tmp_path, capsys):
    folder = tmp_path / "new" / "report"
    assert main(["bench", "raster", "--quick", "--json", "--device", "cpu", "--output", str(folder)]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["rows"] == [{"phantom": "flat", "hit_rate": 0.5}]
    assert values["quick"] is True
    assert {"hardware", "versions", "commit", "seeds", "configuration"} <= set(values)
    assert sorted(path.name for path in folder.iterdir()) == ["a.png", "raster.json", "raster.md"]
    assert instant[0].quick
    assert instant[0].device == "cpu"


def test_the_table_is_for_people(instant, capsys):
    assert main(["bench", "raster"]) == 0
    output = capsys.readouterr().out
    assert "hits %" in output
    assert "50" in output
    assert "All differs." in output


def test_a_result_without_a_row_is_no_success(instant, monkeypatch, capsys):
    """All scans of a folder unreadable, say: the reason is printed, and a script sees that it failed."""
    from octn_ros.evaluation.benchmark import BenchmarkResult

    empty = BenchmarkResult("raster", "a table", [], [], [], ["All differs."], ["broken.nii: damaged"], {}, {}, 0.1, {})
    monkeypatch.setattr(sys.modules["instant_benchmark"], "run", lambda request: empty)
    assert main(["bench", "raster"]) == 2
    printed = capsys.readouterr()
    assert "broken.nii: damaged" in printed.out
    assert "octn bench: error: nothing could be measured" in printed.err


def test_a_wide_table_is_written_out(instant, monkeypatch, capsys):
    """Thirty columns on a terminal of 80 letters: every title and every value in full."""
    from octn_ros.evaluation.benchmark import BenchmarkResult, Column

    columns = [Column(f"k{i}", f"a rather long title {i}") for i in range(30)]
    wide = BenchmarkResult("raster", "wide", [{f"k{i}": 1000 + i for i in range(30)}], columns, [], [], [], {}, {}, 0.1)
    monkeypatch.setattr(sys.modules["instant_benchmark"], "run", lambda request: wide)
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["bench", "raster"]) == 0
    output = capsys.readouterr().out
    for i in range(30):
        assert f"a rather long title {i}" in output
        assert str(1000 + i) in output
    assert output.count("a rather long title 0") == 1, "what is no terminal gets one table"


def test_a_wide_table_on_a_terminal_goes_on_below(instant, monkeypatch, capsys):
    """Each part begins with what a row is about, and none is wider than the terminal."""
    from octn_ros.evaluation.benchmark import BenchmarkResult, Column

    columns = [Column("scan", "scan"), *(Column(f"k{i}", f"long title {i}") for i in range(12)), Column("no", "empty")]
    row = {"scan": "wavy", **{f"k{i}": 1000 + i for i in range(12)}}
    wide = BenchmarkResult("raster", "wide", [row], columns, [{"scan": "paper", "k3": 7}], [], [], {}, {}, 0.1)
    monkeypatch.setattr(sys.modules["instant_benchmark"], "run", lambda request: wide)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["bench", "raster"]) == 0
    output = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert output.count("wavy") == output.count("paper") == output.count("long title 0") > 1
    for i in range(12):
        assert f"long title {i}" in output
        assert str(1000 + i) in output
    assert "empty" not in output
    assert max(map(len, output.splitlines())) <= 80


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("magic",), "invalid choice: 'magic'"),
        (("raster", "--data", "missing"), "expected a folder of C-scans"),
        (("raster", "--device", "abacus"), "abacus"),
        (("sparse", "--workers", "-1"), "--workers: expected a number of processes"),
        (("sparse", "--quick", "--scheduler", "nonsense://x"), "address of a running Dask scheduler"),
        (("raster", "--rois", "rois.yaml"), "expected bscan, raster has no regions"),
        (("bscan", "--rois", "missing.yaml"), "missing.yaml"),
    ],
)
def test_bad_arguments_are_one_line(arguments, words, capsys):
    assert main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("octn bench: error: ")
    assert words in error
    assert error.count("\n") == 1


def test_all_has_a_folder_of_its_own(instant, tmp_path, monkeypatch, capsys):
    """Without --output the report of all lies in octn-bench-quick; a second run measures nothing again."""
    from octn_ros.evaluation import all_benchmarks

    only = all_benchmarks.AllBenchConfig(names=("raster",))
    monkeypatch.setattr(all_benchmarks, "AllBenchConfig", lambda: only)
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["bench", "all", "--quick", "--device", "cpu", "--workers", "1"]) == 0
    assert len(instant) == 1
    assert instant[0].workers == 1
    assert "octn-bench-quick/report.md" in capsys.readouterr().err
    names = {path.name for path in (tmp_path / "octn-bench-quick").iterdir()}
    assert {"report.md", "raster.md", "raster.json", "all.json", "a.png"} <= names
