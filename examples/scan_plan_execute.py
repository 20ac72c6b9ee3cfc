"""Drive a running graph: scan, wait for the field, plan a raster, execute it. With ROS 2 or without.

Usage: python examples/scan_plan_execute.py X1_MM Y1_MM X2_MM Y2_MM    (opposite corners in the OCT frame)
"""

import sys

import octn_ros.nodes  # noqa: F401 - makes rclpy and the message packages importable where ROS 2 is missing

# isort: split
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.srv import GetPlan
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import status
from octn_ros.nodes.client import GraphClient


def state_of(message: DiagnosticArray) -> str:
    """Return the word that a status message carries for its node's state."""
    return status.read(message)[2]["state"]


def is_fitted_since(message: DiagnosticArray, time_ns: int) -> bool:
    """Return whether a planner's report is about a fitted field, of a scan taken since then."""
    values = status.read(message)[2]
    return values.get("field_kind") == "neural" and int(values["stamp_ns"]) >= time_ns


def ask(client: GraphClient, service: str) -> None:
    """Call one of the Trigger services, and stop with its own words if it refuses."""
    answer = client.call(Trigger, service, Trigger.Request(), timeout_s=10)
    if not answer.success:
        raise SystemExit(answer.message)
    print(f"{service}: {answer.message}")


def drive(corners_m: list[float]) -> None:
    """Work the graph through one scan."""
    with GraphClient() as client:
        planner = client.watch(DiagnosticArray, "plan_status")
        arm = client.watch(DiagnosticArray, "execution_status")
        asked_ns = client.node.get_clock().now().nanoseconds
        ask(client, "scan")
        # The field through the measured voxels comes first, then the fitted one, which takes its plans away again. A
        # trainer that was started again may have published the one it kept, of an older scan.
        planner.wait(120, lambda message: is_fitted_since(message, asked_ns))

        request = GetPlan.Request()  # its tolerance is the line spacing in metres, 0 for the planner's parameter
        request.start.header.frame_id = request.goal.header.frame_id = "oct_optical_frame"
        request.start.pose.position.x, request.start.pose.position.y = corners_m[:2]
        request.goal.pose.position.x, request.goal.pose.position.y = corners_m[2:]
        path = client.call(GetPlan, "plan_raster", request, timeout_s=30).plan
        print(f"plan: {len(path.poses)} waypoints in {path.header.frame_id}", status.read(planner.messages[-1])[1])

        if path.poses:
            arm.wait(10, lambda message: state_of(message) == "staged")
            client.call(SetBool, "enable_laser", SetBool.Request(data=True), timeout_s=10)
            ask(client, "execute")
            done = arm.wait(300, lambda message: state_of(message) in ("done", "aborted"))
            print("arm:", status.read(done)[1])


if __name__ == "__main__":
    corners_mm = [float(argument) for argument in sys.argv[1:]]
    if len(corners_mm) != 4:
        sys.exit(__doc__)
    rclpy.init()
    try:
        drive([corner * 1e-3 for corner in corners_mm])
    finally:
        rclpy.try_shutdown()
