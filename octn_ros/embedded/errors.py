"""Errors that genuine rclpy raises from its C++ part, and the refusal of what the embedded runtime lacks."""

# ruff: noqa: N818 - rclpy's names
from __future__ import annotations


class RCLError(RuntimeError):
    """An operation that ROS 2's client library refuses, e.g. publishing after shutdown."""


class InvalidHandle(RuntimeError):
    """Use of an entity that was destroyed."""


def needs_ros2(name: str) -> NotImplementedError:
    """Return the error to raise for `name`, a part of rclpy that the embedded runtime does not have."""
    return NotImplementedError(f"{name} is not in the embedded runtime: it needs ROS 2, see https://docs.ros.org")
