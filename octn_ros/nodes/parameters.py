"""ROS parameters made from the core's frozen configurations, and configurations made from ROS parameters."""

from __future__ import annotations

import dataclasses
import difflib
import sys
import typing
from collections.abc import Callable, Collection, Iterator
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from octn_ros.errors import OctnError

Config = TypeVar("Config")

_LARGEST_INTEGER = (1 << 63) - 1


class ConfigParameters(Generic[Config]):
    """The parameters of one configuration: declared with descriptors, checked when set, read back as the dataclass.

    Nested configurations become dotted names (`raster.line_spacing_m`). A value that the configuration itself refuses
    is refused by the node with the configuration's reason. Safe to read from any thread: what is set together is read
    together.

    Args:
        node: the node that owns the parameters.
        default: the configuration whose values are the defaults.
        prefix: put before every name, with a dot.
        read_only: names (without prefix) that can be given at the start only; True for all of them.
        leave_out: names (without prefix) that are not for this node to choose; they keep the default.
        changed: called after any of them was set, when `config` returns the new values.

    Raises:
        ConfigurationError: the values given at the start do not fit together.
    """

    def __init__(
        self,
        node: Node,
        default: Config,
        prefix: str = "",
        *,
        read_only: Collection[str] | bool = (),
        leave_out: Collection[str] = (),
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._default, self._changed = default, changed
        self._prefix = f"{prefix}." if prefix else ""
        self._types: dict[str, Any] = {}
        for name, value, hint, metadata in _settings(default):
            if name in leave_out:
                continue
            fixed = read_only if isinstance(read_only, bool) else name in read_only
            self._types[name] = hint
            plain = list(value) if isinstance(value, tuple) else float(value) if hint is float else value
            node.declare_parameter(self._prefix + name, plain, _descriptor(hint, metadata, fixed))
        self._values = {name: node.get_parameter(self._prefix + name).value for name in self._types}
        self._config = self._build(self._values)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def config(self) -> Config:
        """Return the configuration that the parameters now state."""
        return self._config

    def _build(self, values: dict[str, Any]) -> Config:
        typed = {}
        for name, value in values.items():
            many = typing.get_origin(self._types[name]) is tuple and not isinstance(value, (str, bytes))
            typed[name] = tuple(value) if many else value
        return _replace(self._default, typed)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._build({**self._values, **self._own(parameters)})
        except (OctnError, TypeError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        # Who else is called when parameters were set may be called before this, so `changed` is for whoever reads them.
        if own := self._own(parameters):
            self._values |= own
            self._config = self._build(self._values)
            self._changed()

    def _own(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Return the values of those parameters that are of this configuration, by their names without the prefix."""
        return {
            parameter.name.removeprefix(self._prefix): parameter.value
            for parameter in parameters
            if parameter.name.startswith(self._prefix) and parameter.name.removeprefix(self._prefix) in self._types
        }


def undeclared_parameters(node: Node) -> list[str]:
    """Return the parameters that were given to a node at its start and that it does not have, in words.

    rclpy ignores them without a word: a misspelt file of keep-out regions would be none. Call it when the node has
    declared all of its own.
    """
    known = node.list_parameters([], 0).names
    # Private, and yet the only place where rclpy 7.1 keeps what nobody asked for.
    given = getattr(node, "_parameter_overrides", {})
    words = []
    for name in sorted(set(given) - set(known)):
        near = difflib.get_close_matches(name, known, n=1)
        words.append(f"{name} (did you mean {near[0]}?)" if near else name)
    return words


def _settings(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any, typing.Mapping[str, Any]]]:
    """Yield dotted name, value, type and metadata of every setting of a configuration and of those nested in it."""
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{prefix}{field.name}.")
        elif "description" in field.metadata:
            yield prefix + field.name, value, hints[field.name], field.metadata


def _replace(config: Any, values: dict[str, Any]) -> Any:
    """Return a configuration with the settings of dotted names replaced, checked again by its constructor."""
    own = {name: value for name, value in values.items() if "." not in name}
    nested: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        head, dot, rest = name.partition(".")
        if dot:
            nested.setdefault(head, {})[rest] = value
    for head, inner in nested.items():
        own[head] = _replace(getattr(config, head), inner)
    return dataclasses.replace(config, **own)


def _descriptor(hint: Any, metadata: typing.Mapping[str, Any], read_only: bool) -> ParameterDescriptor:
    unit, low, high = metadata["unit"], metadata["low"], metadata["high"]
    text = metadata["description"] + (f" [{unit}]" if unit else "")
    notes = []
    if metadata["choices"]:
        notes.append("one of " + ", ".join(metadata["choices"]))
    if low is not None:
        notes.append(f"at least {low:.12g}")
    if high is not None:
        notes.append(f"at most {high:.12g}")
    descriptor = ParameterDescriptor(
        description=text, additional_constraints="; ".join(notes), read_only=read_only, dynamic_typing=False
    )
    if low is None and high is None:
        return descriptor
    # A range has two ends; an open one is the largest number of the type. Arrays have none: the check above holds.
    if hint is float:
        largest = sys.float_info.max
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-largest if low is None else float(low), to_value=largest if high is None else float(high)
            )
        ]
    elif hint is int:
        descriptor.integer_range = [
            IntegerRange(
                from_value=-_LARGEST_INTEGER if low is None else int(low),
                to_value=_LARGEST_INTEGER if high is None else int(high),
                step=1,
            )
        ]
    return descriptor
