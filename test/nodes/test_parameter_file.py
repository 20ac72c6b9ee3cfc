"""config/octn.yaml says what the code says, and the nodes understand it."""

import difflib
import itertools
from pathlib import Path

import pytest
import rclpy
import yaml

from octn_ros.nodes.every_node import NODES
from octn_ros.nodes.parameter_file import parameter_file
from octn_ros.resources import config_path


@pytest.fixture(scope="module")
def text() -> str:
    return config_path("octn.yaml").read_text(encoding="utf-8")


def test_the_file_is_the_one_that_the_code_writes(ros: None, text: str) -> None:
    difference = "\n".join(difflib.unified_diff(text.splitlines(), parameter_file().splitlines(), lineterm="", n=0))
    assert not difference, f"run `python -m octn_ros.nodes.parameter_file > config/octn.yaml`:\n{difference}"


def test_every_parameter_has_a_comment(text: str) -> None:
    lines = [line.strip() for line in text.splitlines()]
    for above, line in itertools.pairwise(lines):
        if line and not line.startswith(("#", "/**")) and line != "ros__parameters:":
            assert above.startswith("#"), line


def test_the_nodes_take_their_values_from_the_file(text: str, tmp_path: Path) -> None:
    changed = yaml.safe_load(text)
    assert set(changed) == {f"/**/{kind.__name__.lower()}" for kind in NODES}
    changed["/**/planner"]["ros__parameters"]["raster.line_spacing_m"] = 7e-5
    changed["/**/trainer"]["ros__parameters"]["fit.steps"] = 77
    path = tmp_path / "octn.yaml"
    path.write_text(yaml.safe_dump(changed), encoding="utf-8")
    rclpy.init(args=["--ros-args", "--params-file", str(path)])
    try:
        for kind in NODES:
            node = kind()
            for name, value in changed[f"/**/{node.get_name()}"]["ros__parameters"].items():
                found = node.get_parameter(name).value
                assert (found if isinstance(value, (str, bool, int, float)) else list(found)) == value, name
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
