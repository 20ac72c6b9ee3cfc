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


def refuse_arguments(function: str, **given: object) -> None:
    """Refuse arguments of rclpy that would have no effect here.

    Args:
        function: name of the function that got them.
        given: arguments by name; None and False count as not given.

    Raises:
        NotImplementedError: for the first one that is given.
    """
    for name, value in given.items():
        if value is not None and value is not False:
            raise needs_ros2(f"argument '{name}' of {function}")
