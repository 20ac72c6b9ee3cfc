"""The services through which other processes read and set a node's parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

from .exceptions import ParameterNotDeclaredException
from .parameter import Parameter
from .qos import qos_profile_parameters

if TYPE_CHECKING:
    from .node import Node


class ParameterService:
    """Offers the six parameter services of a node, in the node's default callback group.

    Names that are not declared are left out of answers, as in rclpy.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        for kind, name, answer in (
            (DescribeParameters, "describe_parameters", self._describe),
            (GetParameters, "get_parameters", self._get),
            (GetParameterTypes, "get_parameter_types", self._get_types),
            (ListParameters, "list_parameters", self._list),
            (SetParameters, "set_parameters", self._set),
            (SetParametersAtomically, "set_parameters_atomically", self._set_atomically),
        ):
            node.create_service(kind, f"~/{name}", answer, qos_profile=qos_profile_parameters)

    def _known(self, names: list[str]) -> list[str]:
        return [n for n in names if self._node.has_parameter(n) or self._node._allow_undeclared_parameters]

    def _describe(self, request: Any, response: Any) -> Any:
        response.descriptors = self._node.describe_parameters(self._known(request.names))
        return response

    def _get(self, request: Any, response: Any) -> Any:
        known = self._known(request.names)
        response.values = [self._node.get_parameter_or(n).get_parameter_value() for n in known]
        return response

    def _get_types(self, request: Any, response: Any) -> Any:
        response.types = [self._node.get_parameter_or(n).type_.value for n in self._known(request.names)]
        return response

    def _list(self, request: Any, response: Any) -> Any:
        response.result = self._node.list_parameters(list(request.prefixes), request.depth)
        return response

    def _set(self, request: Any, response: Any) -> Any:
        response.results = [self._refusable(lambda p: self._node.set_parameters(p)[0], [p]) for p in request.parameters]
        return response

    def _set_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._refusable(self._node.set_parameters_atomically, request.parameters)
        return response

    @staticmethod
    def _refusable(setter: Callable[[list[Parameter]], Any], messages: list[Any]) -> Any:
        try:
            return setter([Parameter.from_parameter_msg(m) for m in messages])
        except ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))
