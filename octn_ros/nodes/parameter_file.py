"""The text of config/octn.yaml, from the nodes' own declarations.

Write it again with `python -m octn_ros.nodes.parameter_file > config/octn.yaml`.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from typing import Any

from rclpy.node import Node

from octn_ros.nodes.every_node import every_node, print_text

WIDTH = 110  # of a comment

_HEAD = """\
# Every parameter of every node, with its default. `ros2 param describe /octn/trainer NAME` says the same.
#
#   ros2 run octn_ros trainer --ros-args --params-file octn.yaml
#   ros2 launch octn_ros octn.launch.py params_file:=octn.yaml
#
# Written by `python -m octn_ros.nodes.parameter_file`, and held against the code by a test. The defaults of fit.*
# come from the preset, so they are commented out here: take the # away to fix one whatever the preset.
"""
_OF_PRESET = "fit."
_OF_RCLPY = ("use_sim_time", "start_type_description_service")


def parameter_file() -> str:
    """Return the text of config/octn.yaml; rclpy must be initialised. Makes each node once and ends it again."""
    parts = [_HEAD]
    for node in every_node():
        parts.append("\n".join((f"/**/{node.get_name()}:", "  ros__parameters:", *_lines(node), "")))
    return "\n".join(parts)


def _lines(node: Node) -> Iterator[str]:
    names = sorted(node.get_parameters_by_prefix(""), key=lambda name: (name.count("."), name))
    for name in names:
        if name in _OF_RCLPY or name.startswith("qos_overrides"):
            continue
        descriptor = node.describe_parameter(name)
        notes = [descriptor.description, descriptor.additional_constraints]
        notes.append("given at the start only" if descriptor.read_only else "")
        for line in textwrap.wrap("; ".join(filter(None, notes)), WIDTH):
            yield f"    # {line}"
        mark = "# " if name.startswith(_OF_PRESET) else ""
        yield f"    {mark}{name}: {_scalar(node.get_parameter(name).value)}"


def _scalar(value: Any) -> str:
    if isinstance(value, float):
        mantissa, exponent, power = repr(value).partition("e")
        # Without a point some YAML readers take 5e-05 for a string.
        return mantissa + (".0" if "." not in mantissa else "") + exponent + power
    if isinstance(value, (bool, int, str)):
        return json.dumps(value)
    return f"[{', '.join(_scalar(item) for item in value)}]"


if __name__ == "__main__":
    print_text(parameter_file)
