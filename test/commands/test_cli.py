"""The command line as a whole: help, version, exit codes, one line per error, and what it does not import."""

import re
import subprocess
import sys

import pytest

from octn_ros import __version__
from octn_ros.cli import main
from octn_ros.commands.info import InfoCommand
from octn_ros.commands.terminal import (
    CommandError,
    ProgressBar,
    check_output_file,
    make_output_directory,
    print_json,
    write_text,
)


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"octn {__version__}\n"


@pytest.mark.parametrize("command", ["demo", "fit", "plan", "run", "info"])
def test_every_command_has_help_and_json(command, capsys):
    assert main([command, "--help"]) == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "start"),
    [
        ([], "octn: error: "),
        (["bake"], "octn: error: "),
        (["fit"], "octn fit: error: "),
        (["fit", "a.nii", "-o", "b.safetensors", "--steps", "many"], "octn fit: error: argument --steps"),
        (["info", "a.nii", "--spacing-um", "1", "2"], "octn info: error: argument --spacing-um"),
        (["run", "barista"], "octn run: error: argument node"),
    ],
)
def test_a_bad_argument_is_one_line_and_exit_code_2(argv, start, capsys):
    assert main(argv) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith(start)
    assert output.err.count("\n") == 1


def test_an_interrupt_is_exit_code_130(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(InfoCommand, "run", interrupted)
    assert main(["info", "a.nii"]) == 130
    assert capsys.readouterr().err == "octn info: interrupted\n"


def test_a_programming_error_is_not_hidden(monkeypatch):
    def broken(self):
        raise ZeroDivisionError

    monkeypatch.setattr(InfoCommand, "run", broken)
    with pytest.raises(ZeroDivisionError):
        main(["info", "a.nii"])


def test_importing_the_command_line_loads_nothing_heavy():
    code = (
        "import sys, octn_ros.cli\n"
        "heavy = {'torch', 'rclpy', 'zenoh', 'matplotlib', 'numpy', 'rich', 'nibabel'} & set(sys.modules)\n"
        "sys.exit(repr(heavy) if heavy else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("columns", [80, 60])
def test_a_narrow_terminal_cuts_the_remark_and_nothing_else(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    with ProgressBar() as bar:
        bar.show("fitting the field", 0.4, "fine, step 120, 31.05 dB " * 4)
    line = capsys.readouterr().err.rstrip("\n")
    assert "\n" not in line
    assert re.fullmatch(r"fitting the field  \S{20} 100% 0:00:0\d fine, .*…", line)


def test_a_demo_tells_of_a_missing_file_before_it_imports_the_nodes(tmp_path):
    asks = (
        "import sys\nfrom octn_ros.cli import main\n"
        f"code = main(['demo', '--volume', 'missing.nii', '--output', {str(tmp_path)!r}])\n"
        "sys.exit(code if not any(name.startswith(('torch', 'rclpy')) for name in sys.modules) else 99)"
    )
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, "missing.nii: no such file" in done.stderr) == (2, True), done.stderr


def test_json_has_null_for_what_it_cannot_hold(capsys):
    print_json({"psnr_db": float("inf"), "list": [1.5, float("nan")], "nested": {"x": (True, None, "a")}})
    assert capsys.readouterr().out == ('{"psnr_db": null, "list": [1.5, null], "nested": {"x": [true, null, "a"]}}\n')


def test_an_output_that_cannot_be_written_is_found_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    check_output_file(tmp_path / "new")
    check_output_file(tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"], "nothing is left behind"
    with pytest.raises(CommandError, match="got a directory"):
        check_output_file(tmp_path)
    for bad in (tmp_path / "missing" / "new", tmp_path / "file" / "new"):
        with pytest.raises(CommandError, match="cannot write here"):
            check_output_file(bad)
    with pytest.raises(CommandError, match="cannot write here"):
        make_output_directory(tmp_path / "file" / "folder")
    with pytest.raises(CommandError, match="cannot write here"):
        write_text(tmp_path / "missing" / "new", "text")
    make_output_directory(tmp_path / "a" / "b")
    write_text(tmp_path / "a" / "b" / "new", "20 um")
    assert (tmp_path / "a" / "b" / "new").read_text(encoding="utf-8") == "20 um"
