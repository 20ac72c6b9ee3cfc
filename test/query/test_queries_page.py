"""The examples of docs/queries.md do what the page says."""

import re
import shlex
from pathlib import Path

import matplotlib as mpl
import pytest

from octn_ros.cli import main
from octn_ros.query.slice_spec import FORMS
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import save_volume

PAGE = (Path(__file__).parents[2] / "docs" / "queries.md").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")
    return tmp_path


def test_the_python_of_the_page_runs_from_top_to_bottom(folder, capsys):
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    exec(compile(code, "docs/queries.md", "exec"), {})
    assert "positive in air" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"surface.stl", "band.ply"}


def test_the_commands_of_the_page_run(folder):
    phantom = make_phantom(PhantomConfig(shape=(16, 64, 24), surface="tilted"))
    save_volume("scan.nii.gz", phantom.volume)
    commands = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
    assert len(commands) >= 5
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "octn"
        assert main(arguments) == 0, command


def test_the_page_knows_every_picture():
    for kind in FORMS:
        assert f"`{kind}:" in PAGE
