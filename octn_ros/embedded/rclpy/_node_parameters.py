"""The part of a node that keeps its parameters."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from math import isclose
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import (
    ListParametersResult,
    ParameterDescriptor,
    ParameterEvent,
    ParameterValue,
    SetParametersResult,
)

from .exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from .parameter import PARAMETER_SEPARATOR_STRING, Parameter, parameter_value_to_python

if TYPE_CHECKING:
    from .clock import ROSClock
    from .publisher import Publisher

NOT_SET = Parameter.Type.NOT_SET
_NAME = re.compile(r"[^\s]+")


class NodeParameters:
    """Declares, checks and sets parameters, with rclpy's rules.

    Not safe for changes from several threads at once; the parameter services run in the node's default callback group.
    """

    PARAM_REL_TOL = 1e-6  # how far a number may be from a bound or step
    _clock: ROSClock
    _parameter_events: Publisher

    def __init__(self, overrides: dict[str, Any], allow_undeclared_parameters: bool) -> None:
        self._overrides = overrides
        self._allow_undeclared_parameters = allow_undeclared_parameters
        self._parameters: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._pre_set: list[Callable[[list[Parameter]], list[Parameter]]] = []
        self._on_set: list[Callable[[list[Parameter]], Any]] = []
        self._post_set: list[Callable[[list[Parameter]], None]] = []

    def get_fully_qualified_name(self) -> str:
        """Return the node's full name."""
        raise NotImplementedError

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter and return it; see `declare_parameters`."""
        only_name = value is None and descriptor is None
        declaration = (name,) if only_name else (name, value, descriptor or ParameterDescriptor())
        return self.declare_parameters("", [declaration], ignore_override)[0]

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare parameters, with the values given for the node at its start where there are some.

        Args:
            namespace: put in front of the names, with a dot, unless empty.
            parameters: tuples (name, default value or Parameter.Type, ParameterDescriptor); the last may be missing.
            ignore_override: use the default values in any case.

        Raises:
            ParameterAlreadyDeclaredException: one was declared before.
            InvalidParameterException: a name is not allowed.
            InvalidParameterTypeException: the value given at the start is of another type than the default.
            InvalidParameterValueException: the value is out of range, or a callback refused it.
            TypeError, ValueError: a tuple makes no sense.
        """
        declared, descriptors = [], {}
        for declaration in parameters:
            if not 1 <= len(declaration) <= 3 or not isinstance(declaration[0], str):
                raise TypeError(f"a declaration is (name, default or type, descriptor), got {declaration!r}")
            name = f"{namespace}{PARAMETER_SEPARATOR_STRING}{declaration[0]}" if namespace else declaration[0]
            if not _NAME.fullmatch(name):
                raise InvalidParameterException(name)
            descriptor = declaration[2] if len(declaration) == 3 else ParameterDescriptor()
            if not isinstance(descriptor, ParameterDescriptor):
                raise TypeError(f"the third element of {declaration!r} is not a ParameterDescriptor")
            if len(declaration) == 1:
                warnings.warn(
                    f"when declaring parameter named '{name}', declaring a parameter only providing its name is "
                    "deprecated: give a default value, a type, or a descriptor with dynamic_typing=True",
                    stacklevel=2,
                )
                descriptor.dynamic_typing = True
            value = _default_of(name, declaration[1] if len(declaration) > 1 else None, descriptor)
            if not ignore_override and name in self._overrides:
                value = self._overrides[name]
            declared.append(_typed(name, Parameter.Type(descriptor.type), value))
            descriptors[name] = descriptor
        if again := [p.name for p in declared if p.name in self._parameters]:
            raise ParameterAlreadyDeclaredException(again)
        for parameter in declared:
            result = self._set([parameter], descriptors)
            if result.reason.startswith("Wrong parameter type"):
                expected = Parameter.Type(descriptors[parameter.name].type).name
                raise InvalidParameterTypeException(parameter, expected)
            if not result.successful:
                raise InvalidParameterValueException(parameter.name, parameter.value, result.reason)
        return [self._parameters[p.name] for p in declared]

    def undeclare_parameter(self, name: str) -> None:
        """Forget a parameter; raise if it was not declared or is read-only."""
        if name not in self._parameters:
            raise ParameterNotDeclaredException(name)
        if self._descriptors[name].read_only:
            raise ParameterImmutableException(name)
        del self._parameters[name], self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        """Return whether a parameter is declared."""
        return name in self._parameters

    def get_parameter(self, name: str) -> Parameter:
        """Return a parameter.

        Raises:
            ParameterNotDeclaredException: it is not declared, and the node does not allow that.
            ParameterUninitializedException: it was declared with a type only and has no value.
        """
        parameter = self._parameters.get(name)
        if parameter is None:
            if self._allow_undeclared_parameters:
                return Parameter(name, NOT_SET)
            raise ParameterNotDeclaredException(name)
        if parameter.type_ == NOT_SET and not self._descriptors[name].dynamic_typing:
            raise ParameterUninitializedException(name)
        return parameter

    def get_parameters(self, names: list[str]) -> list[Parameter]:
        """Return parameters; see `get_parameter`."""
        return [self.get_parameter(n) for n in names]

    def get_parameter_or(self, name: str, alternative_value: Parameter | None = None) -> Parameter:
        """Return a parameter, or the alternative (by default one that is not set) if it has no value."""
        parameter = self._parameters.get(name)
        if parameter is not None and parameter.type_ != NOT_SET:
            return parameter
        return Parameter(name, NOT_SET) if alternative_value is None else alternative_value

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        """Return the parameters whose names begin with `prefix` and a dot, by the rest of their names."""
        head = prefix + PARAMETER_SEPARATOR_STRING if prefix else ""
        return {n[len(head) :]: p for n, p in self._parameters.items() if n.startswith(head)}

    def describe_parameter(self, name: str) -> Any:
        """Return the descriptor of a parameter; raise ParameterNotDeclaredException if there is none."""
        if name not in self._descriptors and not self._allow_undeclared_parameters:
            raise ParameterNotDeclaredException(name)
        return self._descriptors.get(name) or ParameterDescriptor()

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
            ParameterNotDeclaredException: one is not declared, and the node does not allow that.
        """
        if self._pre_set:
            parameter_list = [p for callback in self._pre_set for p in callback(parameter_list)]
            if not parameter_list:
                return _refused(
                    "parameter list cannot be empty, this might be due to "
                    "pre_set_parameters_callback modifying the original parameters list."
                )
        if not all(isinstance(p, Parameter) for p in parameter_list):
            raise TypeError(f"parameter must be instance of type '{Parameter!r}'")
        unknown = [p.name for p in parameter_list if p.name not in self._parameters]
        if unknown and not self._allow_undeclared_parameters:
            raise ParameterNotDeclaredException(unknown)
        return self._set(parameter_list, None)

    def _set(self, parameters: list[Parameter], new_descriptors: dict[str, Any] | None) -> Any:
        """Check, store and announce; with descriptors of their own the parameters are being declared."""
        declaring = new_descriptors is not None
        descriptors = self._descriptors if new_descriptors is None else new_descriptors
        for p in parameters:
            if p.name in descriptors and (reason := self._refusal(p, descriptors[p.name], declaring)):
                return _refused(reason)
        for check in self._on_set:
            result = check(parameters)
            if not result.successful:
                return result
        event = ParameterEvent(node=self.get_fully_qualified_name(), stamp=self._clock.now().to_msg())
        for p in parameters:
            if p.type_ == NOT_SET and not declaring:
                event.deleted_parameters.append(p.to_parameter_msg())
                self._parameters.pop(p.name, None)
                self._descriptors.pop(p.name, None)
                continue
            is_new = self.get_parameter_or(p.name).type_ == NOT_SET
            (event.new_parameters if is_new else event.changed_parameters).append(p.to_parameter_msg())
            self._descriptors[p.name] = descriptors.get(p.name) or ParameterDescriptor(dynamic_typing=True)
            self._parameters[p.name] = p
        self._parameter_events.publish(event)
        for callback in self._post_set:
            callback(parameters)
        return SetParametersResult(successful=True)

    def _refusal(self, parameter: Parameter, descriptor: Any, declaring: bool) -> str:
        """Return why a parameter may not be set, or nothing; completes the descriptor."""
        descriptor.name = parameter.name
        if descriptor.read_only and not declaring:
            return f"Trying to set a read-only parameter: {parameter.name}."
        if descriptor.dynamic_typing:
            descriptor.type = parameter.type_.value
        elif parameter.type_ == NOT_SET:
            return "" if declaring else "Static parameter cannot be undeclared"
        elif parameter.type_.value != descriptor.type:
            return f"Wrong parameter type, expected '{Parameter.Type(descriptor.type)}' got '{parameter.type_}'"
        if parameter.type_ == Parameter.Type.INTEGER and descriptor.integer_range:
            return self._out_of_range(parameter, descriptor.integer_range[0], lambda a, b: a == b)
        if parameter.type_ == Parameter.Type.DOUBLE and descriptor.floating_point_range:
            return self._out_of_range(
                parameter, descriptor.floating_point_range[0], lambda a, b: isclose(a, b, rel_tol=self.PARAM_REL_TOL)
            )
        return ""

    @staticmethod
    def _out_of_range(parameter: Parameter, bounds: Any, equal: Callable[[Any, Any], bool]) -> str:
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

    def add_pre_set_parameters_callback(self, callback: Callable[[list[Parameter]], list[Parameter]]) -> None:
        """Call `callback` before parameters are checked; it returns the parameters to set instead."""
        self._pre_set.insert(0, callback)

    def add_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Call `callback` to check parameters; it returns a SetParametersResult and changes nothing."""
        self._on_set.insert(0, callback)

    def add_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], None]) -> None:
        """Call `callback` after parameters were set."""
        self._post_set.insert(0, callback)

    def remove_pre_set_parameters_callback(self, callback: Callable[[list[Parameter]], list[Parameter]]) -> None:
        """Take back `add_pre_set_parameters_callback`; raise ValueError if it was not added."""
        self._pre_set.remove(callback)

    def remove_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        """Take back `add_on_set_parameters_callback`; raise ValueError if it was not added."""
        self._on_set.remove(callback)

    def remove_post_set_parameters_callback(self, callback: Callable[[list[Parameter]], None]) -> None:
        """Take back `add_post_set_parameters_callback`; raise ValueError if it was not added."""
        self._post_set.remove(callback)


def _refused(reason: str) -> Any:
    return SetParametersResult(successful=False, reason=reason)


def _default_of(name: str, given: Any, descriptor: Any) -> Any:
    """Return the default value in a declaration, and write its type into the descriptor."""
    if isinstance(given, Parameter.Type):
        if given == NOT_SET:
            raise ValueError(f"Cannot declare parameter {{{name}}} as statically typed of type NOT_SET")
        if descriptor.dynamic_typing:
            raise ValueError(f"When declaring parameter {{{name}}} by type, `dynamic_typing=True` is not allowed")
        descriptor.type = given.value
        return None
    value = parameter_value_to_python(given) if isinstance(given, ParameterValue) else given
    if not descriptor.dynamic_typing:
        kind = given.type if isinstance(given, ParameterValue) else Parameter.Type.from_parameter_value(given).value
        if kind == NOT_SET.value:
            raise ValueError("Cannot declare a statically typed parameter with default value of type PARAMETER_NOT_SET")
        descriptor.type = kind
    return value


def _typed(name: str, wanted: Parameter.Type, value: Any) -> Parameter:
    """Return a parameter; an empty list takes the type it was declared with."""
    empty = isinstance(value, (list, tuple)) and not value and wanted.name.endswith("_ARRAY")
    return Parameter(name, wanted if empty else None, value)
