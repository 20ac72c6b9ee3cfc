"""What the demos ask of the graph's services; a node that refuses ends the demo with its reason."""

from __future__ import annotations

import octn_ros.nodes  # noqa: F401 - makes the message packages importable where ROS 2 is missing

# isort: split
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.srv import GetPlan, LoadMap
from std_srvs.srv import SetBool, Trigger

from octn_ros.demo.graph import DemoError
from octn_ros.demo.rectangle import Corner
from octn_ros.nodes import status
from octn_ros.nodes.client import GraphClient, Watch

# How long is waited for an answer and for a plan, in seconds: limits for what hangs, since what fails says so. Either
# takes a second or less, and has been seen to take over 15 where others had the processors.
ANSWER_S = 120.0
PLAN_S = 300.0


def trigger(client: GraphClient, service: str, timeout_s: float = ANSWER_S) -> None:
    """Call a service that takes no arguments.

    Raises:
        DemoError: its node refuses.
        TimeoutError: it does not answer.
    """
    response = client.call(Trigger, service, Trigger.Request(), timeout_s)
    if not response.success:
        raise DemoError(f"{service}: {response.message}")


def enable_laser(client: GraphClient) -> None:
    """Let the next execution fire.

    Raises:
        DemoError: the arm refuses.
        TimeoutError: it does not answer.
    """
    response = client.call(SetBool, "enable_laser", SetBool.Request(data=True), ANSWER_S)
    if not response.success:
        raise DemoError(f"enable_laser: {response.message}")


def publish_slice(client: GraphClient, cut: str) -> None:
    """Have the field cut and the cut published on `slice`.

    Args:
        client: asks.
        cut: where, in the words of `query_slice`, such as `bscan:63.5`.

    Raises:
        DemoError: the query node refuses; the reason is in its log.
        TimeoutError: it does not answer.
    """
    response = client.call(LoadMap, "query_slice", LoadMap.Request(map_url=cut), ANSWER_S)
    if response.result != LoadMap.Response.RESULT_SUCCESS:
        raise DemoError(f"query_slice {cut}: refused with code {response.result}; the query node's log says why")


def plan_rectangle(
    client: GraphClient,
    plan_status: Watch[DiagnosticArray],
    corners_m: tuple[Corner, Corner],
    frame: str,
    line_spacing_m: float,
    field_hash: str,
) -> dict[str, str]:
    """Have a raster over a rectangle planned; return the planner's report on it, values by name.

    Args:
        client: asks.
        plan_status: what was heard of the planner's reports; it has said that it has the field.
        corners_m: opposite corners (x, y) of the rectangle.
        frame: in which they are.
        line_spacing_m: between the lines.
        field_hash: of the field that the plan must be made on.

    Raises:
        DemoError: the planner refuses, or its report and its answer are not of one plan.
        TimeoutError: it does not answer.
    """
    request = GetPlan.Request(tolerance=line_spacing_m)
    for pose, (x, y) in zip((request.start, request.goal), corners_m, strict=True):
        pose.header.frame_id = frame
        pose.pose.position.x, pose.pose.position.y = x, y
    seen = len(plan_status.messages)
    response = client.call(GetPlan, "plan_raster", request, PLAN_S)

    def refused(report: DiagnosticArray) -> bool:
        return status.read(report)[2].get("state") in ("refused", "failed")

    if not response.plan.poses:  # the reason comes by another way than the answer, and may come after it
        raise DemoError(status.read(plan_status.wait(ANSWER_S, refused, after=seen))[1])

    def planned(report: DiagnosticArray) -> bool:
        values = status.read(report)[2]
        return values.get("state") == "planned" and values["field_hash"] == field_hash

    plan = status.read(plan_status.wait(ANSWER_S, planned, after=seen))[2]
    if int(plan["waypoints"]) != len(response.plan.poses):
        raise DemoError(f"expected {plan['waypoints']} poses from plan_raster, got {len(response.plan.poses)}")
    return plan
