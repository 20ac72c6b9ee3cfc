"""docs/benchmarks.md: every benchmark is on it, every command on it exists, and so does every key it names."""

import re
from pathlib import Path

import pytest

from octn_ros.evaluation import alpha, bscan, curve, sparse
from octn_ros.evaluation.registry import MODULES

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks.md"


def test_every_benchmark_is_on_the_page():
    named = set(re.findall(r"octn bench ([a-z]+)", PAGE.read_text(encoding="utf-8")))
    assert named - {"all"} == set(MODULES) - {"all"}


@pytest.mark.parametrize("module", [alpha, bscan, sparse])
def test_keys_of_the_page_are_columns(module):
    name = module.__name__.rpartition(".")[2]
    section = re.search(rf"^## {name}:.*?(?=^## |\Z)", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert section is not None
    keys = set(re.findall(r"`([a-z_]+_(?:db|um|epi|rise)|roi|variant|preset|epi|ssim)`", section[0]))
    assert keys
    assert keys <= {column.key for column in module.COLUMNS}


def test_pictures_of_the_page_are_drawn():
    content = Path(curve.__file__).read_text(encoding="utf-8")
    for picture in re.findall(r"`(curve-[a-z-]+\.png)`", PAGE.read_text(encoding="utf-8")):
        assert picture in content
