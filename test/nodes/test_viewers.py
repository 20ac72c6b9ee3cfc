"""What RViz and Foxglove show: topics that are there, settings that both know, and a scan that fills the picture.

Neither program is needed. Both pass over a setting that they do not know without a word, and take their default, so
the names, values and limits they have are listed here, as read in RViz 14.1 (Jazzy) and in Lichtblick 1.28, the open
Foxglove Studio: a name that is new in the files is to be looked up there first.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from octn_ros.nodes import band_publisher, surface_publisher
from octn_ros.nodes.transforms import BSCAN_FRAME
from octn_ros.planning import load_calibration
from octn_ros.resources import config_path
from octn_ros.simulation import PhantomConfig

REPOSITORY = Path(__file__).parents[2]
CALIBRATION = load_calibration(config_path("calibration.yaml"))
FRAMES = {
    CALIBRATION.oct_frame,
    CALIBRATION.ee_frame,
    CALIBRATION.base_frame,
    CALIBRATION.laser_frame,
    BSCAN_FRAME,
}
COLUMNS = {"/octn/surface": surface_publisher.COLUMNS, "/octn/band": band_publisher.COLUMNS}
SHOWN = {"enface", "slice", "surface", "band", "path", "plan_markers", "waypoints_oct", "plan_preview", "ee_pose"}

# What an RViz display shows, of which message, and what else can be set of it.
RVIZ: dict[str, tuple[str, set[str]]] = {
    "Map": ("nav_msgs/msg/OccupancyGrid", {"Alpha", "Color Scheme", "Draw Behind", "Use Timestamp"}),
    "PointCloud2": (
        "sensor_msgs/msg/PointCloud2",
        {"Style", "Size (m)", "Size (Pixels)", "Alpha", "Selectable", "Position Transformer", "Color Transformer"}
        | {"Channel Name", "Use rainbow", "Invert Rainbow", "Min Color", "Max Color", "Autocompute Intensity Bounds"},
    ),
    "PoseArray": ("geometry_msgs/msg/PoseArray", {"Shape", "Color", "Alpha", "Arrow Length"}),
    "Path": ("nav_msgs/msg/Path", {"Line Style", "Line Width", "Color", "Alpha", "Pose Style"}),
    "MarkerArray": ("visualization_msgs/msg/MarkerArray", {"Namespaces"}),
    "Image": ("sensor_msgs/msg/Image", {"Normalize Range", "Min Value", "Max Value", "Median window"}),
    "Pose": ("geometry_msgs/msg/PoseStamped", {"Shape", "Color", "Alpha", "Axes Length", "Axes Radius"}),
    "PointStamped": ("geometry_msgs/msg/PointStamped", {"Color", "Alpha", "Radius", "History Length"}),
    "TF": ("tf2_msgs/msg/TFMessage", {"Show Names", "Show Axes", "Show Arrows", "Marker Scale", "Frames"}),
}
EVERY_DISPLAY = {"Class", "Name", "Enabled", "Value", "Topic"}
TOPIC = {"Depth", "Durability Policy", "History Policy", "Reliability Policy", "Value"}
VIEW = {"Class", "Name", "Value", "Target Frame", "Near Clip Distance"}
VIEWS = {
    "Orbit": VIEW
    | {"Invert Z Axis", "Distance", "Focal Point", "Focal Shape Fixed Size", "Focal Shape Size", "Pitch", "Yaw"},
    "TopDownOrtho": VIEW | {"Angle", "Scale", "X", "Y"},
}
CHOICES = {
    "Color Scheme": {"map", "costmap", "raw"},
    "Style": {"Points", "Squares", "Flat Squares", "Spheres", "Boxes", "Tiles"},
    "Shape": {"Arrow (Flat)", "Arrow (3D)", "Axes"},
    "Line Style": {"Lines", "Billboards"},
    "Position Transformer": {"XYZ"},
    "Color Transformer": {"Intensity", "RGB8", "RGBF32", "AxisColor", "FlatColor"},
}
DOCKS = {"rviz_common/Displays", "rviz_common/Views", "Image"}
# RViz raises what is less, which at the scale of a scan shows.
LEAST = {"Size (m)": 1e-4, "Size (Pixels)": 1.0, "Line Width": 1e-3, "Distance": 1e-3, "Near Clip Distance": 1e-3}

# What Foxglove's panels show, and what can be set of a topic in the 3D panel.
PANELS = {
    "3D": {name for kind, (name, _) in RVIZ.items() if kind not in ("Image", "TF", "PointStamped")},
    "Image": {"sensor_msgs/msg/Image"},
    "RawMessages": {"diagnostic_msgs/msg/DiagnosticArray"},
    "DiagnosticSummary": {"diagnostic_msgs/msg/DiagnosticArray"},
}
POSES = {"visible", "type", "axisScale", "arrowScale"}
IN_3D = {
    "nav_msgs/msg/OccupancyGrid": {"visible", "colorMode", "minColor", "maxColor", "unknownColor", "invalidColor"},
    "sensor_msgs/msg/PointCloud2": {"visible", "colorField", "colorMode", "colorMap", "gradient", "pointSize"},
    "geometry_msgs/msg/PoseArray": POSES | {"lineWidth", "gradient"},
    "nav_msgs/msg/Path": POSES | {"lineWidth", "gradient"},
    "geometry_msgs/msg/PoseStamped": POSES | {"color"},
    "visualization_msgs/msg/MarkerArray": {"visible"},
}
COLOUR_MODES = {
    "nav_msgs/msg/OccupancyGrid": {"custom", "map", "costmap", "raw"},
    "sensor_msgs/msg/PointCloud2": {"flat", "gradient", "colormap"},
}


def published() -> dict[str, tuple[str, str]]:
    """(type, QoS) of each topic that a node publishes, by its full name, as the interface page has them."""
    page = (REPOSITORY / "docs" / "interfaces.md").read_text(encoding="utf-8")
    tables = "".join(part.split("\n\n")[0] for part in page.split("| Publishes |")[1:])
    rows = re.findall(r"^\| `(\S+)` \| (\S+) \| ([^|]+) \|", tables, re.MULTILINE)
    return {name if name.startswith("/") else f"/octn/{name}": (kind, qos) for name, kind, qos in rows}


def rviz() -> Any:
    return yaml.safe_load((REPOSITORY / "rviz" / "octn.rviz").read_text(encoding="utf-8"))


def foxglove() -> Any:
    return json.loads((REPOSITORY / "foxglove" / "octn.json").read_text(encoding="utf-8"))


def plugin(settings: Any) -> str:
    return str(settings["Class"]).removeprefix("rviz_default_plugins/")


def test_rviz_shows_topics_that_are_there_with_the_quality_they_have() -> None:
    view, topics, shown = rviz()["Visualization Manager"], published(), set()
    for display in view["Displays"]:
        kind = plugin(display)
        if kind == "TF":
            assert {"/tf", "/tf_static"} < topics.keys()
            continue
        topic = display["Topic"]
        assert topics[topic["Value"]][0] == RVIZ[kind][0], display["Name"]
        qos = topics[topic["Value"]][1]
        kept = qos == "latched" or "kept" in qos
        reliable = qos == "latched" or "reliable" in qos
        assert topic["Durability Policy"] == ("Transient Local" if kept else "Volatile"), display["Name"]
        assert topic["Reliability Policy"] == ("Reliable" if reliable else "Best Effort"), display["Name"]
        assert topic["History Policy"] == "Keep Last"
        assert topic.keys() == TOPIC
        shown.add(topic["Value"].removeprefix("/octn/"))
    assert shown == SHOWN | {"clicked_surface"}
    assert view["Global Options"]["Fixed Frame"] == CALIBRATION.oct_frame
    (click,) = [tool for tool in view["Tools"] if plugin(tool) == "PublishPoint"]
    assert click["Topic"]["Value"] == "/clicked_point"


def test_rviz_knows_all_that_is_set() -> None:
    file = rviz()
    view = file["Visualization Manager"]
    for display in view["Displays"]:
        assert display.keys() - EVERY_DISPLAY <= RVIZ[plugin(display)][1], display["Name"]
        assert display["Enabled"] == display["Value"], display["Name"]
        assert display.get("Frames", {}).keys() <= FRAMES
        if plugin(display) == "PointCloud2":
            assert display["Channel Name"] in COLUMNS[display["Topic"]["Value"]]
            # Otherwise the size is another one than the style goes by, and the default counts.
            assert ("Size (Pixels)" if display["Style"] == "Points" else "Size (m)") in display
        elif plugin(display) == "Image":
            # A median over several pictures makes whole numbers of the limits of floats: 0 and 0.
            is_float = display["Topic"]["Value"] == "/octn/slice"
            assert not is_float or display["Median window"] == 1 or not display["Normalize Range"]
    views = [view["Views"]["Current"], *view["Views"]["Saved"]]
    for seen in views:
        assert seen.keys() <= VIEWS[plugin(seen)], seen["Name"]
        assert seen["Target Frame"] in FRAMES | {"<Fixed Frame>"}, seen["Name"]
    for settings in [*view["Displays"], *views]:
        assert re.fullmatch(r"rviz_default_plugins/\w+", settings["Class"])
        for name, value in settings.items():
            assert name not in CHOICES or value in CHOICES[name], (settings["Name"], name)
            assert name not in LEAST or float(value) >= LEAST[name], (settings["Name"], name)
            assert "Color" not in name or name in CHOICES or re.fullmatch(r"\d+; \d+; \d+", value), name
    assert {panel["Class"] for panel in file["Panels"]} <= {"rviz_common/Displays", "rviz_common/Views"}
    assert {plugin(tool) for tool in view["Tools"]} <= {"MoveCamera", "Select", "PublishPoint"}
    geometry = file["Window Geometry"]
    assert (geometry["Hide Left Dock"], geometry["Hide Right Dock"]) == (False, False)
    # Qt puts a dock of a name that its state does not have wherever there is room.
    docks = {entry["Name"] for entry in [*file["Panels"], *view["Displays"]] if plugin(entry) in DOCKS}
    state = bytes.fromhex(geometry["QMainWindow State"])
    assert len(docks) == 4
    assert {dock for dock in docks if dock.encode("utf-16-be") in state} == docks


def _panels(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        assert layout["direction"] in ("row", "column")
        yield from _panels(layout["first"])
        yield from _panels(layout["second"])


def test_foxglove_shows_topics_that_are_there() -> None:
    layout, topics, shown = foxglove(), published(), set()
    assert sorted(_panels(layout["layout"])) == sorted(layout["configById"])
    for panel, settings in layout["configById"].items():
        kind = panel.partition("!")[0]
        named = re.findall(r'"(/[\w/]+)"', json.dumps({**settings, "publish": None}))
        assert named, panel
        for topic in named:
            assert topics[topic][0] in PANELS[kind], (panel, topic)
            shown.add(topic.removeprefix("/octn/"))
    assert shown > SHOWN


def test_foxglove_knows_all_that_is_set() -> None:
    layout, topics = foxglove(), published()
    # It refuses a layout without these.
    assert isinstance(layout["globalVariables"], dict)
    assert isinstance(layout["playbackConfig"]["speed"], int)
    panel = layout["configById"]["3D!octn"]
    for topic, settings in panel["topics"].items():
        kind = topics[topic][0]
        assert settings.keys() <= IN_3D[kind], topic
        assert settings.get("colorMode") in {None, *COLOUR_MODES.get(kind, ())}, topic
        assert settings.get("colorField") in {None, *COLUMNS.get(topic, ())}, topic
        assert settings.get("type") in (None, "axis", "arrow", "line"), topic
    assert panel["followTf"] == CALIBRATION.oct_frame
    assert {name.removeprefix("frame:") for name in panel["transforms"]} <= FRAMES
    # Without it nothing before the place that one jumps to is known of the arm, so the scan lies where the arm is now.
    assert panel["scene"]["transforms"]["enablePreloading"] is True


def _from_above(pitch: float, yaw: float, up: float) -> NDArray[np.float64]:
    return np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), up * np.sin(pitch)])


def _rviz_camera() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    view = rviz()["Visualization Manager"]["Views"]["Current"]
    up = -1.0 if view["Invert Z Axis"] else 1.0
    target = np.array([view["Focal Point"][axis] for axis in "XYZ"], dtype=np.float64)
    away = float(view["Distance"]) * _from_above(view["Pitch"], up * view["Yaw"], up)
    return target + away, target, np.array([0.0, 0.0, up]), float(view["Near Clip Distance"])


def _foxglove_camera() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]:
    state = foxglove()["configById"]["3D!octn"]["cameraState"]
    target = np.array(state["targetOffset"], dtype=np.float64)
    pitch, yaw = np.radians(90.0 - state["phi"]), np.radians(state["thetaOffset"] - 90.0)
    away = float(state["distance"]) * _from_above(pitch, yaw, 1.0)
    return target + away, target, np.array([0.0, 0.0, 1.0]), float(state["near"])


@pytest.mark.parametrize("camera", [_rviz_camera, _foxglove_camera])
def test_the_default_scan_fills_the_picture_as_the_probe_sees_it(camera: Any) -> None:
    place, target, up, near_m = camera()
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    along, axial, across = PhantomConfig().geometry.extent_m
    corners = np.array([(x, y, z) for x in (0.0, across) for y in (0.0, along) for z in (0.0, axial)]) - place
    depth = corners @ forward
    seen = np.column_stack([corners @ right, corners @ above]) / depth[:, None] / np.tan(np.radians(22.5))
    assert forward[2] > 0.7  # into the tissue
    assert right[0] > 0.95  # x to the right and y down, as in the plan's preview
    assert above[1] < -0.5
    assert near_m < depth.min() / 2
    assert np.abs(seen).max() < 1.0
    assert (np.ptp(seen, axis=0) > 0.9).all()
