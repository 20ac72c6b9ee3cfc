"""Asks a planner for one raster many times at once, prints a hash of each answer: a process of `test_faults_load`."""

from __future__ import annotations

import hashlib
import sys

import octn_ros.nodes  # noqa: F401 - makes rclpy importable where ROS 2 is missing

# isort: split
import rclpy
from nav_msgs.srv import GetPlan

from octn_ros.nodes import qos
from octn_ros.nodes.client import GraphClient

TIMEOUT_S = 60.0


def main(name: str, count: int) -> None:
    rclpy.init(args=[])
    with GraphClient(name) as client:
        service = client.node.create_client(GetPlan, "plan_raster", qos_profile=qos.SERVICES)
        client.wait_for(service.service_is_ready, TIMEOUT_S, "planner")
        request = GetPlan.Request(tolerance=1e-4)
        for pose, place_m in ((request.start, 2e-4), (request.goal, 6e-4)):
            pose.header.frame_id = "oct_optical_frame"
            pose.pose.position.x = pose.pose.position.y = place_m
        futures = [service.call_async(request) for _ in range(count)]
        client.wait_for(lambda: all(future.done() for future in futures), TIMEOUT_S, f"{count} answers")
        for future in futures:
            path = future.result().plan
            # Their words say all of a pose, to the last digit; the package's own conversions import torch, for seconds.
            poses = "".join(str(stamped.pose) for stamped in path.poses)
            print(len(path.poses), hashlib.sha256(poses.encode()).hexdigest())
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
