"""The launch files, where ROS 2 is installed."""

from pathlib import Path

import pytest

LAUNCH = Path(__file__).parents[2] / "launch"

sources = pytest.importorskip("launch.launch_description_sources", reason="needs ROS 2")
launch = pytest.importorskip("launch", reason="needs ROS 2")


@pytest.mark.parametrize("name", ["octn.launch.py", "demo.launch.py"])
def test_a_launch_file_declares_its_arguments(name: str) -> None:
    source = sources.PythonLaunchDescriptionSource(str(LAUNCH / name))
    description = source.get_launch_description(launch.LaunchContext())
    declared = {argument.name for argument in description.get_launch_arguments()}
    assert {"namespace", "params_file", "calibration", "device", "preset"} <= declared
