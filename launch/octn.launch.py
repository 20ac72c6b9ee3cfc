"""Trainer, query and planner: the nodes that a real scanner and a real arm are connected to."""

import re
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

# An argument left empty changes nothing: the parameter stays as params_file has it.
ARGUMENTS = {
    "calibration": "calibration file (YAML) instead of the package's",
    "device": "where fields are fitted and evaluated: auto, cpu, cuda, cuda:1, ...",
    "preset": "preset of the fit: fast, paper, ... (octn fit --help lists them)",
    "bscan_count": "B-scans of a C-scan, as the scanner sends them",
    "spacing_um": "voxel spacing of the B-scans in micrometres: BSCAN AXIAL LATERAL; BSCAN 0: the poses tell it",
    "data_root": "folder below which load_cscan may read files",
}


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("octn_ros")
    parameters = PathJoinSubstitution([share, "config", "octn.yaml"])
    view = PathJoinSubstitution([share, "rviz", "octn.rviz"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="octn", description="namespace of all nodes"),
            DeclareLaunchArgument(
                "params_file", default_value=parameters, description="parameters of all nodes (YAML)"
            ),
            DeclareLaunchArgument(
                "rviz", default_value="false", choices=["true", "false"], description="show it in RViz"
            ),
            DeclareLaunchArgument("rviz_config", default_value=view, description="what RViz shows"),
            DeclareLaunchArgument(
                "ee_transform",
                default_value="true",
                choices=["true", "false"],
                description="publish ee_pose on /tf; false where the robot's own driver publishes that transform",
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in ARGUMENTS.items()
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    asked = ("namespace", "params_file", "rviz_config", "ee_transform", *ARGUMENTS)
    given = {name: LaunchConfiguration(name).perform(context) for name in asked}
    stated: dict[str, Any] = {
        name: given[name] for name in ("calibration", "device", "preset", "data_root") if given[name]
    }
    if given["bscan_count"]:
        stated["bscan_count"] = int(given["bscan_count"])
    if given["spacing_um"]:
        stated["spacing_um"] = [float(number) for number in given["spacing_um"].replace(",", " ").split()]
    if given["ee_transform"] == "false":
        stated["transforms.moving"] = False
    taken = {
        "trainer": ("device", "preset", "bscan_count", "spacing_um", "data_root"),
        "query": ("device", "calibration"),
        "planner": ("device", "calibration", "transforms.moving"),
    }
    nodes = [
        Node(
            package="octn_ros",
            executable=node,
            namespace=given["namespace"],
            parameters=[given["params_file"], {name: stated[name] for name in names if name in stated}],
            output="screen",
        )
        for node, names in taken.items()
    ]
    view = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", given["rviz_config"]],
        remappings=_remappings(given["rviz_config"], given["namespace"].strip("/")),
        condition=IfCondition(LaunchConfiguration("rviz")),
        output="screen",
    )
    return [*nodes, view]


def _remappings(config: str, namespace: str) -> list[tuple[str, str]]:
    """Return where RViz finds the topics of its file, which names them under /octn."""
    path = Path(config)
    topics = sorted(set(re.findall(r"/octn/(\w+)", path.read_text(encoding="utf-8")))) if path.is_file() else []
    root = f"/{namespace}" if namespace else ""
    return [] if namespace == "octn" else [(f"/octn/{topic}", f"{root}/{topic}") for topic in topics]
