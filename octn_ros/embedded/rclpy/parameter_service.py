"""The services through which other processes read and set a node's parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rcl_interfaces import srv
from rcl_interfaces.msg import SetParametersResult

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
        self._offer(srv.DescribeParameters, "describe_parameters", "descriptors", self._describe)
        self._offer(srv.GetParameters, "get_parameters", "values", self._get)
        self._offer(srv.GetParameterTypes, "get_parameter_types", "types", self._types)
        self._offer(srv.ListParameters, "list_parameters", "result", self._list)
        self._offer(srv.SetParameters, "set_parameters", "results", self._set)
        self._offer(srv.SetParametersAtomically, "set_parameters_atomically", "result", self._set_atomically)

    def _offer(self, kind: Any, name: str, field: str, answer: Callable[[Any], Any]) -> None:
        """Offer a service whose response has one field."""

        def respond(request: Any, response: Any) -> Any:
            setattr(response, field, answer(request))
            return response

        self._node.create_service(kind, f"~/{name}", respond, qos_profile=qos_profile_parameters)

    def _known(self, names: list[str]) -> list[str]:
        return [n for n in names if self._node.has_parameter(n)]

    def _describe(self, request: Any) -> list[Any]:
        return self._node.describe_parameters(self._known(request.names))

    def _get(self, request: Any) -> list[Any]:
        return [p.get_parameter_value() for p in self._node.get_parameters(self._known(request.names))]

    def _types(self, request: Any) -> list[int]:
        return [p.type_.value for p in self._node.get_parameters(self._known(request.names))]

    def _list(self, request: Any) -> Any:
        return self._node.list_parameters(list(request.prefixes), request.depth)

    def _set(self, request: Any) -> list[Any]:
        return [self._set_all([parameter]) for parameter in request.parameters]

    def _set_atomically(self, request: Any) -> Any:
        return self._set_all(request.parameters)

    def _set_all(self, messages: list[Any]) -> Any:
        try:
            return self._node.set_parameters_atomically([Parameter.from_parameter_msg(m) for m in messages])
        except ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))
