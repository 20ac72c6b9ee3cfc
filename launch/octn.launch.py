"""Trainer, query and planner: the nodes that a real scanner and a real arm are connected to."""

from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

# An argument left empty changes nothing: the parameter stays as params_file has it.
ARGUMENTS = {
    "calibration": "calibration file (YAML) instead of the package's",
    "device": "where fields are fitted and evaluated: auto, cpu, cuda, cuda:1, ...",
    "preset": "preset of the fit: fast or paper",
    "bscan_count": "B-scans of a C-scan, as the scanner sends them",
    "spacing_um": "voxel spacing of the B-scans in micrometres: BSCAN AXIAL LATERAL",
}


def generate_launch_description() -> LaunchDescription:
    defaults = PathJoinSubstitution([FindPackageShare("octn_ros"), "config", "octn.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="octn", description="namespace of all nodes"),
            DeclareLaunchArgument("params_file", default_value=defaults, description="parameters of all nodes (YAML)"),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in ARGUMENTS.items()
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    given = {name: LaunchConfiguration(name).perform(context) for name in ("namespace", "params_file", *ARGUMENTS)}
    stated: dict[str, Any] = {name: given[name] for name in ("calibration", "device", "preset") if given[name]}
    if given["bscan_count"]:
        stated["bscan_count"] = int(given["bscan_count"])
    if given["spacing_um"]:
        stated["spacing_um"] = [float(number) for number in given["spacing_um"].replace(",", " ").split()]
    taken = {
        "trainer": ("device", "preset", "bscan_count", "spacing_um"),
        "query": ("device", "calibration"),
        "planner": ("device", "calibration"),
    }
    return [
        Node(
            package="octn_ros",
            executable=node,
            namespace=given["namespace"],
            parameters=[given["params_file"], {name: stated[name] for name in names if name in stated}],
            output="screen",
        )
        for node, names in taken.items()
    ]
