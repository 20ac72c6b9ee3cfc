"""The ROS 2 nodes: each declares parameters, wires topics and services, and calls one core object.

Importing this package makes `rclpy` importable where ROS 2 is not installed.
"""

from octn_ros import embedded

embedded.install()
