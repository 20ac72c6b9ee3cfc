"""What a node's clock follows: the machine, or /clock where the parameter `use_sim_time` is true."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosgraph_msgs.msg import Clock as ClockMessage

from .callback_groups import ReentrantCallbackGroup
from .parameter import Parameter
from .qos import QoSProfile, QoSReliabilityPolicy
from .time import Time

if TYPE_CHECKING:
    from .node import Node
    from .subscription import Subscription

USE_SIM_TIME = "use_sim_time"


class TimeSource:
    """Declares `use_sim_time` for a node and moves its clock; before the first message of /clock the time is 0."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Subscription | None = None
        if not node.has_parameter(USE_SIM_TIME):
            node.declare_parameter(USE_SIM_TIME, False)
        node.add_post_set_parameters_callback(self._follow)
        self._follow([node.get_parameter(USE_SIM_TIME)])

    def _follow(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name != USE_SIM_TIME:
                continue
            if parameter.value and self._subscription is None:
                self._node._clock._simulate(0)
                self._subscription = self._node.create_subscription(
                    ClockMessage,
                    "/clock",
                    self._move,
                    QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT),
                    callback_group=ReentrantCallbackGroup(),
                )
            elif not parameter.value and self._subscription is not None:
                self._node.destroy_subscription(self._subscription)
                self._subscription = None
                self._node._clock._simulate(None)

    def _move(self, message: Any) -> None:
        if self._subscription is not None:
            self._node._clock._simulate(Time.from_msg(message.clock).nanoseconds)
