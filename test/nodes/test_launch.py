"""The launch files, where ROS 2 is installed; what RViz and Foxglove show, anywhere."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from octn_ros.planning import load_calibration
from octn_ros.resources import config_path

REPOSITORY = Path(__file__).parents[2]
# What a display shows, of which message; a display of another kind is not known here.
RVIZ = {
    "Map": "nav_msgs/msg/OccupancyGrid",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "PoseArray": "geometry_msgs/msg/PoseArray",
    "Path": "nav_msgs/msg/Path",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Image": "sensor_msgs/msg/Image",
    "Pose": "geometry_msgs/msg/PoseStamped",
}
FOXGLOVE = {
    "Image": {"sensor_msgs/msg/Image"},
    "RawMessages": {"diagnostic_msgs/msg/DiagnosticArray"},
    "DiagnosticSummary": {"diagnostic_msgs/msg/DiagnosticArray"},
    "3D": {kind for name, kind in RVIZ.items() if name != "Image"},
}
SHOWN = {"enface", "slice", "surface", "band", "path", "plan_markers", "waypoints_oct", "plan_preview", "ee_pose"}


def published() -> dict[str, tuple[str, str]]:
    """(type, QoS) of each topic that a node publishes, by its full name, as the interface page has them."""
    page = (REPOSITORY / "docs" / "interfaces.md").read_text(encoding="utf-8")
    tables = "".join(part.split("\n\n")[0] for part in page.split("| Publishes |")[1:])
    rows = re.findall(r"^\| `(\S+)` \| (\S+) \| ([^|]+) \|", tables, re.MULTILINE)
    return {name if name.startswith("/") else f"/octn/{name}": (kind, qos) for name, kind, qos in rows}


def test_rviz_shows_topics_that_are_there_with_the_quality_they_have() -> None:
    view = yaml.safe_load((REPOSITORY / "rviz" / "octn.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    topics = published()
    displays = {display["Name"]: display for display in view["Displays"]}
    shown = set()
    for display in displays.values():
        kind = display["Class"].removeprefix("rviz_default_plugins/")
        if kind == "TF":
            assert {"/tf", "/tf_static"} < topics.keys()
            continue
        topic = display["Topic"]
        assert topics[topic["Value"]][0] == RVIZ[kind], display["Name"]
        latched = topics[topic["Value"]][1] == "latched"
        assert topic["Durability Policy"] == ("Transient Local" if latched else "Volatile"), display["Name"]
        shown.add(topic["Value"].removeprefix("/octn/"))
    assert shown == SHOWN
    assert view["Global Options"]["Fixed Frame"] == load_calibration(config_path("calibration.yaml")).oct_frame
    (click,) = [tool for tool in view["Tools"] if tool["Class"].endswith("PublishPoint")]
    assert click["Topic"]["Value"] == "/clicked_point"


def _panels(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        yield from _panels(layout["first"])
        yield from _panels(layout["second"])


def test_foxglove_shows_topics_that_are_there() -> None:
    layout = json.loads((REPOSITORY / "foxglove" / "octn.json").read_text(encoding="utf-8"))
    topics, shown = published(), set()
    assert sorted(_panels(layout["layout"])) == sorted(layout["configById"])
    for panel, settings in layout["configById"].items():
        kind = panel.partition("!")[0]
        named = re.findall(r'"(/[\w/]+)"', json.dumps({**settings, "publish": None}))
        assert named, panel
        for topic in named:
            assert topics[topic][0] in FOXGLOVE[kind], (panel, topic)
            shown.add(topic.removeprefix("/octn/"))
    assert shown > SHOWN


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
