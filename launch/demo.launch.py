"""All four nodes: the simulated scanner and arm beside trainer, query and planner.

Then: ros2 service call /octn/scan std_srvs/srv/Trigger
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription
from octn_ros.nodes.params_files import read_parameters, simulated_scan

ARGUMENTS = {
    "volume": "C-scan (any file that octn info reads) that the scanner plays; empty = as params_file says",
    "spacing_um": "voxel spacing of volume in micrometres, if the file does not state it: BSCAN AXIAL LATERAL",
    "calibration": "calibration file (YAML) instead of the package's",
    "device": "where fields are fitted and evaluated: auto, cpu, cuda, cuda:1, ...",
    "preset": "preset of the fit: fast, paper, ... (octn fit --help lists them)",
}


def generate_launch_description() -> LaunchDescription:
    defaults = PathJoinSubstitution([FindPackageShare("octn_ros"), "config", "octn.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="octn", description="namespace of all nodes"),
            DeclareLaunchArgument("params_file", default_value=defaults, description="parameters of all nodes (YAML)"),
            DeclareLaunchArgument(
                "rviz", default_value="false", choices=["true", "false"], description="show it in RViz"
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in ARGUMENTS.items()
            ),
            OpaqueFunction(function=_actions),
        ]
    )


def _actions(context: LaunchContext) -> list[Node | IncludeLaunchDescription]:
    given = {
        name: LaunchConfiguration(name).perform(context) for name in ("namespace", "params_file", "rviz", *ARGUMENTS)
    }
    spacing_um = [float(number) for number in given["spacing_um"].replace(",", " ").split()]
    node = "/".join(["", *filter(None, given["namespace"].split("/")), "simulator"])
    scanned = simulated_scan(read_parameters(given["params_file"], node), given["volume"], tuple(spacing_um))
    simulator = {}
    if given["volume"]:
        simulator["volume_file"] = given["volume"]
    if spacing_um:
        simulator["spacing_um"] = spacing_um
    if given["calibration"]:
        simulator["calibration"] = given["calibration"]
    # What the scanner sends is stated to the trainer, as it must be with a real one.
    stated = {
        "bscan_count": str(scanned.shape[0]),
        "spacing_um": " ".join(f"{spacing * 1e6:.9g}" for spacing in scanned.spacing_m),
    }
    passed = {name: given[name] for name in ("namespace", "params_file", "rviz", "calibration", "device", "preset")}
    main = PathJoinSubstitution([FindPackageShare("octn_ros"), "launch", "octn.launch.py"])
    return [
        IncludeLaunchDescription(PythonLaunchDescriptionSource(main), launch_arguments={**passed, **stated}.items()),
        Node(
            package="octn_ros",
            executable="simulator",
            namespace=given["namespace"],
            parameters=[given["params_file"], *filter(None, [simulator])],
            output="screen",
        ),
    ]
