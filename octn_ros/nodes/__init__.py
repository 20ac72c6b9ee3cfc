"""The ROS 2 nodes: each declares parameters, wires topics and services, and calls one core object.

Importing this package makes `rclpy` importable where ROS 2 is not installed.
"""

from octn_ros import embedded
from octn_ros.openmp import wait_passively

embedded.install()
wait_passively()  # a node shares its machine with the rest of the graph
