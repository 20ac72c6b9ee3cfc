"""The part of a node that keeps its parameters."""

from __future__ import annotations

import re
from collections.abc import Callable
from math import isclose
from typing import Any

from rcl_interfaces.msg import ListParametersResult, ParameterDescriptor, ParameterEvent, SetParametersResult

from octn_ros.embedded.errors import needs_ros2

from . import exceptions
from .clock import ROSClock
from .parameter import PARAMETER_SEPARATOR_STRING, Parameter
from .publisher import Publisher


class NodeParameters:
    """Declares, checks and sets parameters of a fixed type, with rclpy's rules.

    Not safe for changes from several threads at once; the parameter services run in the node's default callback group.
    """

    PARAM_REL_TOL = 1e-6  # how far a number may be from a bound or step
    _clock: ROSClock
    _parameter_events: Publisher

    def __init__(self, overrides: dict[str, Any]) -> None:
        self._parameter_overrides = overrides  # rclpy's name for it
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._on_set: list[Callable[[list[Parameter]], Any]] = []
        self._post_set: list[Callable[[list[Parameter]], None]] = []

    def get_fully_qualified_name(self) -> str:
        """Return the node's full name."""
        raise NotImplementedError

    def _were_set(self, parameters: list[Parameter]) -> None:
        """Do what follows from new values."""

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter and return it; see `declare_parameters`."""
        return self.declare_parameters("", [(name, value, descriptor or ParameterDescriptor())], ignore_override)[0]

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare parameters, with the values given for the node at its start where there are some.

        Args:
            namespace: put in front of the names, with a dot, unless empty.
            parameters: tuples (name, default value, ParameterDescriptor); the last may be missing.
            ignore_override: use the default values in any case.

        Raises:
            ParameterAlreadyDeclaredException: one was declared before.
            InvalidParameterException: a name is not allowed.
            InvalidParameterTypeException: the value given at the start is of another type than the default.
            InvalidParameterValueException: the value is out of range, or a callback refused it.
            NotImplementedError: a parameter without default value, or one with `dynamic_typing`.
        """
        declared: dict[str, tuple[Parameter, Any]] = {}
        for declaration in parameters:
            short, default = (*declaration, None)[:2]
            descriptor = declaration[2] if len(declaration) > 2 else ParameterDescriptor()
            name = f"{namespace}{PARAMETER_SEPARATOR_STRING}{short}" if namespace else short
            if not re.fullmatch(r"\S+", name):
                raise exceptions.InvalidParameterException(name)
            if default is None or isinstance(default, Parameter.Type) or descriptor.dynamic_typing:
                raise needs_ros2(f"parameter '{name}' without a default value or with dynamic typing")
            if name in self._parameters or name in declared:
                raise exceptions.ParameterAlreadyDeclaredException(name)
            kind = Parameter.Type.from_parameter_value(default)
            value = default if ignore_override else self._parameter_overrides.get(name, default)
            empty = isinstance(value, (list, tuple)) and not value and kind.name.endswith("_ARRAY")
            # An empty list takes the declared type.
            parameter = Parameter(name, kind, value) if empty else Parameter(name, value=value)
            if parameter.type_ != kind:
                raise exceptions.InvalidParameterTypeException(parameter, kind.name)
            descriptor.name, descriptor.type = name, kind.value
            declared[name] = parameter, descriptor
        for name, (parameter, descriptor) in declared.items():
            result = self._set([parameter], {name: descriptor})
            if not result.successful:
                raise exceptions.InvalidParameterValueException(name, parameter.value, result.reason)
        return [self._parameters[name] for name in declared]

    def has_parameter(self, name: str) -> bool:
        """Return whether a parameter is declared."""
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        """Return a parameter; raise ParameterNotDeclaredException if there is none."""
        if name not in self._parameters:
            raise exceptions.ParameterNotDeclaredException(name)
        return self._parameters[name]

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        """Return parameters; see `get_parameter`."""
        return [self.get_parameter(n) for n in names]

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        """Return the parameters whose names begin with `prefix` and a dot, by the rest of their names."""
        head = prefix + PARAMETER_SEPARATOR_STRING if prefix else ""
        return {n[len(head) :]: p for n, p in self._parameters.items() if n.startswith(head)}

    def describe_parameter(self, name: str) -> Any:
        """Return the descriptor of a parameter; raise ParameterNotDeclaredException if there is none."""
        if name not in self._descriptors:
            raise exceptions.ParameterNotDeclaredException(name)
        return self._descriptors[name]

    def describe_parameters(self, names: list[str]) -> list[Any]:
        """Return the descriptors of parameters; see `describe_parameter`."""
        return [self.describe_parameter(n) for n in names]

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """Return names of parameters and the prefixes in them.

        Args:
            prefixes: names, or beginnings of names up to a dot; empty means all.
            depth: how many parts the names may have below the prefix; 0 means any number.
        """
        result = ListParametersResult()
        for name in self._parameters:
            below = [name[len(p) :].lstrip(".") for p in prefixes or [""] if not p or f"{name}.".startswith(f"{p}.")]
            if any(not rest or not depth or rest.count(PARAMETER_SEPARATOR_STRING) < depth for rest in below):
                result.names.append(name)
                prefix = name.rpartition(PARAMETER_SEPARATOR_STRING)[0]
                if prefix and prefix not in result.prefixes:
                    result.prefixes.append(prefix)
        return result

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        """Set parameters one after another; return a SetParametersResult for each.

        Raises:
            ParameterNotDeclaredException: one is not declared; those before it stay set.
        """
        return [self.set_parameters_atomically([p]) for p in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> Any:
        """Set parameters all or none; return the SetParametersResult.

        Raises:
            ParameterNotDeclaredException: one is not declared.
        """
        if unknown := [p.name for p in parameter_list if p.name not in self._parameters]:
            raise exceptions.ParameterNotDeclaredException(unknown)
        return self._set(parameter_list, self._descriptors)

    def _set(self, parameters: list[Parameter], descriptors: dict[str, Any]) -> Any:
        """Check, store and announce; with descriptors of their own the parameters are being declared."""
        for p in parameters:
            if reason := self._refusal(p, descriptors[p.name]):
                return SetParametersResult(successful=False, reason=reason)
        for check in self._on_set:
            if not (result := check(parameters)).successful:
                return result
        event = ParameterEvent(node=self.get_fully_qualified_name(), stamp=self._clock.now().to_msg())
        for p in parameters:
            told = event.changed_parameters if p.name in self._parameters else event.new_parameters
            told.append(p.to_parameter_msg())
            self._parameters[p.name], self._descriptors[p.name] = p, descriptors[p.name]
        for callback in self._post_set:
            callback(parameters)
        self._parameter_events.publish(event)
        self._were_set(parameters)
        return SetParametersResult(successful=True)

    def _refusal(self, parameter: Parameter, descriptor: Any) -> str:
        """Return why a parameter may not be set, or nothing."""
        if descriptor.read_only and parameter.name in self._parameters:
            return f"Trying to set a read-only parameter: {parameter.name}."
        if parameter.type_ == Parameter.Type.NOT_SET:
            return "Static parameter cannot be undeclared"
        if parameter.type_.value != descriptor.type:
            return f"Wrong parameter type, expected '{Parameter.Type(descriptor.type)}' got '{parameter.type_}'"
        for bounds in descriptor.integer_range if parameter.type_ == Parameter.Type.INTEGER else ():
            return _out_of_range(parameter, bounds, 0.0)
        for bounds in descriptor.floating_point_range if parameter.type_ == Parameter.Type.DOUBLE else ():
            return _out_of_range(parameter, bounds, self.PARAM_REL_TOL)
        return ""

    def add_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Call `callback` to check parameters; it returns a SetParametersResult and changes nothing."""
        self._on_set.insert(0, callback)

    def remove_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Take back `add_on_set_parameters_callback`; raise ValueError if it was not added."""
        self._on_set.remove(callback)

    def add_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], None]) -> None:
        """Call `callback` once parameters have their new values, also when they are declared."""
        self._post_set.insert(0, callback)

    def remove_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], None]) -> None:
        """Take back `add_post_set_parameters_callback`; raise ValueError if it was not added."""
        self._post_set.remove(callback)


def _out_of_range(parameter: Parameter, bounds: Any, tolerance: float) -> str:
    def equal(a: float, b: float) -> bool:
        return a == b or (tolerance > 0 and isclose(a, b, rel_tol=tolerance))

    low, high = sorted((bounds.from_value, bounds.to_value))
    value, step = parameter.value, bounds.step
    told = f"Min: {low}, Max: {high}, value: {value}"
    if equal(value, low) or equal(value, high):  # at the ends, the step does not matter
        return ""
    if not low < value < high:
        return f"Parameter {parameter.name} out of range. {told}"
    if step and not equal(low + round((value - low) / step) * step, value):
        return f"The parameter value for {parameter.name} is not a valid step. {told}, step: {step}"
    return ""
