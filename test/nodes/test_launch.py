"""The launch files, where ROS 2 is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[2]


def _ros() -> tuple[Any, Any]:
    sources = pytest.importorskip("launch.launch_description_sources", reason="needs ROS 2")
    return pytest.importorskip("launch", reason="needs ROS 2"), sources


@pytest.mark.parametrize("name", ["octn.launch.py", "demo.launch.py"])
def test_a_launch_file_declares_its_arguments(name: str) -> None:
    launch, sources = _ros()
    source = sources.PythonLaunchDescriptionSource(str(REPOSITORY / "launch" / name))
    description = source.get_launch_description(launch.LaunchContext())
    arguments = {argument.name: argument for argument in description.get_launch_arguments()}
    assert {"namespace", "params_file", "calibration", "device", "preset", "rviz"} <= arguments.keys()
    assert ("volume" if name.startswith("demo") else "data_root") in arguments
    for argument in arguments.values():
        assert argument.description
        assert argument.default_value is not None
