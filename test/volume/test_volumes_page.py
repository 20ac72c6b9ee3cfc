"""The examples of docs/volumes.md do what the page says."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image

from octn_ros.cli import main
from octn_ros.volume import Volume, save_volume
from octn_ros.volume.loading import _READERS
from octn_ros.volume.saving import _WRITERS

PAGE = (Path(__file__).parents[2] / "docs" / "volumes.md").read_text(encoding="utf-8")
SPACING_M = (28e-6, 14.59e-6, 14e-6)


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """The files that the page names."""
    monkeypatch.chdir(tmp_path)
    array = np.random.default_rng(0).integers(0, 250, (12, 24, 8)).astype(np.uint8)
    np.save("scan.npy", array)
    save_volume("scan.nii.gz", Volume.from_array(array, SPACING_M))
    scipy.io.savemat("matlab.mat", {"scan": array.transpose(1, 2, 0)})
    Path("images").mkdir()
    for index, bscan in enumerate(array):
        Image.fromarray(bscan).save(f"images/bscan_{index}.png")


def blocks(language):
    found = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found
    return found


@pytest.mark.parametrize("code", blocks("python"))
def test_python_runs(code):
    exec(compile(code, "docs/volumes.md", "exec"), {})


@pytest.mark.parametrize("block", blocks("sh"))
def test_commands_run(block, capsys):
    for line in block.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "octn"
        assert main(arguments) == 0, (line, capsys.readouterr().err)


def test_every_suffix_is_on_the_page():
    for suffix in {*_READERS, *_WRITERS} - {".dicom"}:
        assert f"`{suffix}`" in PAGE, suffix
