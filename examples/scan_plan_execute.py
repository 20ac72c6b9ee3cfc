"""Drive a running graph: scan, wait for the field, plan a raster, execute it. With ROS 2 or without.

Usage: python examples/scan_plan_execute.py X1_MM Y1_MM X2_MM Y2_MM    (opposite corners in the OCT frame)
"""

import argparse
import signal
import sys
import time
from collections.abc import Callable

import octn_ros.nodes  # noqa: F401 - makes rclpy and the message packages importable where ROS 2 is missing

# isort: split
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.srv import GetPlan
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import SetBool, Trigger

from octn_ros.nodes import qos, status
from octn_ros.nodes.client import GraphClient, Watch

LARGEST_MM = 100.0  # no C-scan is as wide: what lies beyond has been given in micrometres
# How long is waited for what, in seconds: limits for what hangs, since what is refused says so.
MEETING_S, START_S, ANSWER_S, FIT_S, PLAN_S, EXECUTION_S = 1.0, 120.0, 60.0, 600.0, 120.0, 300.0
LOOK_S = 1.0  # between looks whether the node that is waited for is still there
EXIT_REFUSED, EXIT_INTERRUPTED = 1, 130


class RefusedError(Exception):
    """A node did not do what it was asked for, and has said why."""


def values_of(message: DiagnosticArray) -> dict[str, str]:
    """Return the named figures of a status message."""
    return status.read(message)[2]


def is_end_of_fit(message: DiagnosticArray, since_ns: int) -> bool:
    """Return whether a trainer's report ends the fit of a scan taken since then, for good or bad."""
    values = values_of(message)
    ends = values["state"] in ("done", "refused", "failed", "cancelled")
    return ends and int(values.get("stamp_ns", since_ns)) >= since_ns


def is_fitted_since(message: DiagnosticArray, since_ns: int) -> bool:
    """Return whether a planner's report is about a fitted field, of a scan taken since then."""
    values = values_of(message)
    return values.get("field_kind") == "neural" and int(values["stamp_ns"]) >= since_ns


def is_of_path(message: DiagnosticArray, waypoints: int) -> bool:
    """Return whether a planner's report is about a path that was answered; it may come after the answer."""
    values = values_of(message)
    if waypoints == 0:
        return values["state"] in ("refused", "failed")
    return values["state"] == "planned" and int(values["waypoints"]) == waypoints


def wait_for_node(client: GraphClient, count: Callable[[], int], what: str) -> None:
    """Return once `count` finds somebody; after a moment say what is waited for."""
    try:
        client.wait_for(lambda: count() > 0, MEETING_S, what)
    except TimeoutError:
        print(f"waiting for {what}", file=sys.stderr, flush=True)
        client.wait_for(lambda: count() > 0, START_S, what)


def wait_for_report(
    client: GraphClient,
    watch: Watch[DiagnosticArray],
    topic: str,
    timeout_s: float,
    accept: Callable[[DiagnosticArray], bool],
    after: int = 0,
) -> DiagnosticArray:
    """Return the first report of a node that `accept` says yes to.

    Raises:
        RefusedError: the node has left the graph.
        TimeoutError: with what it said last.
    """
    end = time.monotonic() + timeout_s
    while True:
        try:
            return watch.wait(min(LOOK_S, timeout_s), accept, after=after)
        except TimeoutError as error:
            if client.node.count_publishers(topic) == 0:
                raise RefusedError(f"{topic}: its node has left the graph") from error
            if time.monotonic() >= end:
                last = [status.read(message)[1] for message in watch.messages[-1:]]
                raise TimeoutError(
                    f"{topic}: nothing as awaited in {timeout_s:g} s; the last report: {last}"
                ) from error


def ask(client: GraphClient, service: str, timeout_s: float = ANSWER_S) -> None:
    """Call one of the Trigger services.

    Raises:
        RefusedError: in its own words.
    """
    answer = client.call(Trigger, service, Trigger.Request(), timeout_s)
    if not answer.success:
        raise RefusedError(f"{service}: {answer.message}")
    print(f"{service}: {answer.message}", flush=True)


def drive(corners_m: list[float]) -> None:
    """Work the graph through one scan.

    Raises:
        RefusedError: a node refused or failed.
        TimeoutError: names the node that is missing or did not answer.
    """
    with GraphClient() as client:
        fit = client.watch(DiagnosticArray, "fit_progress", qos.STREAM)
        planner = client.watch(DiagnosticArray, "plan_status")
        arm = client.watch(DiagnosticArray, "execution_status")
        # A scan that nobody listens to is lost, and nothing would be heard of it.
        graph = client.node
        wait_for_node(client, lambda: graph.count_subscribers("bscan"), "a trainer: somebody who subscribes to bscan")
        wait_for_node(client, lambda: graph.count_publishers("plan_status"), "a planner")
        fit.wait_matched(START_S)

        asked_ns = client.node.get_clock().now().nanoseconds
        ask(client, "scan")  # who gives up waiting for an answer has not called the scan off
        print("waiting for the fitted field", file=sys.stderr, flush=True)
        ended = wait_for_report(client, fit, "fit_progress", FIT_S, lambda message: is_end_of_fit(message, asked_ns))
        if values_of(ended)["state"] != "done":
            raise RefusedError(f"trainer: {status.read(ended)[1]}")
        # The field through the measured voxels came first, then the fitted one, which takes its plans away again. A
        # trainer that was started again may have published the one it kept, of an older scan.
        wait_for_report(client, planner, "plan_status", PLAN_S, lambda message: is_fitted_since(message, asked_ns))

        request = GetPlan.Request()  # its tolerance is the line spacing in metres, 0 for the planner's parameter
        request.start.header.frame_id = request.goal.header.frame_id = "oct_optical_frame"
        request.start.pose.position.x, request.start.pose.position.y = corners_m[:2]
        request.goal.pose.position.x, request.goal.pose.position.y = corners_m[2:]
        heard, told = len(arm.messages), len(planner.messages)  # what was said before is of another plan
        path = client.call(GetPlan, "plan_raster", request, PLAN_S).plan
        said = wait_for_report(
            client, planner, "plan_status", ANSWER_S, lambda message: is_of_path(message, len(path.poses)), told
        )
        words = status.read(said)[1]
        if not path.poses:
            raise RefusedError(f"planner: {words}")
        print(f"plan: {len(path.poses)} waypoints in {path.header.frame_id}; {words}", flush=True)

        arm_topic = "execution_status"
        wait_for_node(client, lambda: graph.count_publishers(arm_topic), f"an arm that tells {arm_topic}")
        wait_for_report(
            client, arm, arm_topic, ANSWER_S, lambda message: values_of(message)["state"] == "staged", heard
        )
        heard = len(arm.messages)
        client.call(SetBool, "enable_laser", SetBool.Request(data=True), ANSWER_S)
        ask(client, "execute", EXECUTION_S)  # an arm may answer when it has begun, or when it has come to the end
        done = wait_for_report(
            client,
            arm,
            arm_topic,
            EXECUTION_S,
            lambda message: values_of(message)["state"] in ("done", "aborted"),
            heard,
        )
        print("arm:", status.read(done)[1])
        if values_of(done)["state"] != "done":
            raise RefusedError("the arm has aborted")


def millimetres(text: str) -> float:
    """Read a corner's coordinate."""
    number = float(text)
    if not abs(number) <= LARGEST_MM:
        raise argparse.ArgumentTypeError(
            f"expected millimetres, {LARGEST_MM:g} at most, got {text}; micrometres are divided by 1000"
        )
    return number


def main() -> int:
    """Run once; return 0, 1 where a node refuses or is missing, 130 after SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(description="Scan, wait for the fitted field, plan a raster and execute it.")
    for name in ("X1_MM", "Y1_MM", "X2_MM", "Y2_MM"):
        parser.add_argument(name, type=millimetres, help="of two opposite corners in the OCT frame")
    corners_mm = vars(parser.parse_args(remove_ros_args(sys.argv)[1:])).values()
    # rclpy's own handlers end the graph, but not a program that waits for an answer from it.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        drive([corner * 1e-3 for corner in corners_mm])
    except KeyboardInterrupt:
        print("scan_plan_execute: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (RefusedError, TimeoutError) as error:
        print(f"scan_plan_execute: error: {error}", file=sys.stderr)
        return EXIT_REFUSED
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
