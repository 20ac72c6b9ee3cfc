"""The ROS 2 nodes: each declares parameters, wires topics and services, and calls one core object.

Importing this package makes `rclpy` importable where ROS 2 is not installed, and sets up Fast DDS where it is.
"""

from octn_ros import embedded
from octn_ros.nodes.fast_dds import set_up_fast_dds
from octn_ros.openmp import wait_passively

if not embedded.install():
    set_up_fast_dds()
wait_passively()  # a node shares its machine with the rest of the graph
