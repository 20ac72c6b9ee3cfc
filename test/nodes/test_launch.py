"""The launch files, where ROS 2 is installed."""

from pathlib import Path

import pytest

LAUNCH = Path(__file__).parents[2] / "launch"

launch = pytest.importorskip("launch.launch_description_sources", reason="needs ROS 2")


@pytest.mark.parametrize("name", ["octn.launch.py", "demo.launch.py"])
def test_a_launch_file_declares_its_arguments(name: str) -> None:
    description = launch.PythonLaunchDescriptionSource(str(LAUNCH / name)).get_launch_description(None)
    declared = {argument.name for argument in description.get_launch_arguments()}
    assert {"namespace", "params_file", "calibration", "device", "preset"} <= declared
