"""The ROS arguments of a command line: remaps, parameters, parameter files, log levels."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from octn_ros.embedded.errors import RCLError


class Rule(NamedTuple):
    """`[node:]left:=right`."""

    node: str
    left: str
    right: str

    @classmethod
    def parse(cls, text: str) -> Rule:
        """Return the rule that `text` words, or raise RCLError."""
        left, separator, right = text.partition(":=")
        if not separator or not left:
            raise RCLError(f"Couldn't parse rule '{text}': it must be [node:]name:=value")
        scheme = re.match(r"(rostopic|rosservice)://", left)
        node, _, name = left[scheme.end() if scheme else 0 :].rpartition(":")
        return cls(node, name, right)


class _Loader(yaml.SafeLoader):
    """YAML as rcl reads it: 1e5 is a number, dates and times of day are strings, and so is every key."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - replaces that of SafeLoader
    bool_values = {**yaml.SafeLoader.bool_values, "y": True, "n": False}  # noqa: RUF012 - as above

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a dictionary whose keys are the texts that stand there."""
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}


for _tag, _pattern, _first in (
    ("bool", r"y|Y|yes|Yes|YES|n|N|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF", "yYnNtTfFoO"),
    ("int", r"[-+]?(0x[0-9a-fA-F]+|0|[1-9][0-9]*)", "-+0123456789"),
    ("float", r"[-+]?((\d+\.\d*|\.\d+)([eE][-+]?\d+)?|\d+[eE][-+]?\d+|\.(?i:inf))|\.(?i:nan)", "-+.0123456789"),
    ("null", r"~|null|Null|NULL|", "~nN\0"),
):
    _firsts = [*_first, ""] if _tag == "null" else list(_first)
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _firsts)


def load(text: str) -> Any:
    """Return the value that YAML `text` stands for; it can make nothing but plain values."""
    return yaml.load(text, Loader=_Loader)  # a SafeLoader


class Arguments:
    """What follows `--ros-args`, up to `--`, in a list of arguments; `rest` is everything else.

    Raises:
        RCLError: an unknown argument, one without its value, or a rule that cannot be parsed.
        OSError: a parameter file cannot be read.
    """

    def __init__(self, argv: Sequence[str] = ()) -> None:
        self.remaps: list[Rule] = []
        self.parameters: list[tuple[str, dict[str, Any]]] = []  # (pattern of node names, values), later ones win
        self.log_levels: list[str] = []
        self.rest: list[str] = []
        ours, remaining = False, iter(argv)
        for argument in remaining:
            if not ours and argument != "--ros-args":
                self.rest.append(argument)
            elif argument in ("--ros-args", "--"):
                ours = argument == "--ros-args"
            else:
                value = next(remaining, None)
                if value is None:
                    raise RCLError(f"Found ROS argument '{argument}' without a value, or an unknown one")
                self._take(argument, value)

    def _take(self, argument: str, value: str) -> None:
        if argument in ("-r", "--remap"):
            self.remaps.append(Rule.parse(value))
        elif argument in ("-p", "--param"):
            node, name, text = Rule.parse(value)
            self.parameters.append((f"/**/{node}" if node else "/**", {name: load(text)}))
        elif argument == "--params-file":
            self.add_tree(load(Path(value).read_text(encoding="utf-8")))
        elif argument == "--log-level":
            self.log_levels.append(value)
        else:
            raise RCLError(f"Found unknown ROS argument: '{argument}'")

    def add_tree(self, tree: Any, path: str = "") -> None:
        """Take the parameters of a parameter file, as `load` returns it, or of its branch below the name `path`."""
        for key, branch in (tree or {}).items():
            if key == "ros__parameters":
                self.parameters.append((path, dict(_flatten(branch, ""))))
            elif isinstance(branch, dict):
                self.add_tree(branch, f"{path}/{key.strip('/')}")

    def renamed(self, key: str, node_name: str) -> str | None:
        """Return what the first rule for `key` (`__node` or `__ns`) makes of the node called `node_name`, if any."""
        keys = ("__node", "__name") if key == "__node" else (key,)
        return next((r.right for r in self.remaps if r.left in keys and r.node in ("", node_name)), None)

    def overrides(self, path: str) -> dict[str, Any]:
        """Return the parameter values given for the node with the fully qualified name `path`."""
        values: dict[str, Any] = {}
        for pattern, given in self.parameters:
            if _matches(pattern, path):
                values.update(given)
        return values


def _matches(pattern: str, path: str) -> bool:
    """Return whether a node's name is meant by a pattern, in which ** stands for any names and * for one."""
    regex = re.escape(pattern).replace(r"/\*\*", r"(/[^/]+)*").replace(r"\*", r"[^/]+")
    return re.fullmatch(regex, path) is not None


def _flatten(tree: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in (tree or {}).items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
