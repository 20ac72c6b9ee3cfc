"""Names of rclpy (Jazzy) that the embedded runtime knows and does not have; their use says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from octn_ros.embedded.errors import needs_ros2

_MODULES = """
    action constants endpoint_info event_handler expand_topic_name experimental handle impl lifecycle
    logging_service parameter_client parameter_event_handler qos_event qos_overriding_options service_introspection
    topic_endpoint_info topic_or_service_is_hidden type_description_service type_hash type_support
    validate_full_topic_name validate_namespace validate_node_name validate_parameter_name validate_topic_name
    wait_for_message waitable
"""
ABSENT_MODULES = frozenset(f"rclpy.{name}" for name in _MODULES.split())
ABSENT: dict[str, frozenset[str]] = {
    owner: frozenset(names.split())
    for owner, names in {
        "rclpy": "create_node",
        "rclpy.client.Client": "configure_introspection get_pending_request handle",
        "rclpy.clock": """
            ClockChange ClockHandle JumpHandle JumpThreshold TimeJump TimeJumpDictionary get_default_context
        """,
        "rclpy.clock.Clock": "create_jump_callback handle sleep_for sleep_until",
        "rclpy.context": "ContextHandle",
        "rclpy.context.Context": "destroy handle on_shutdown",
        "rclpy.duration.Duration": "get_c_duration",
        "rclpy.exceptions": "NoTypeSupportImportedException",
        "rclpy.executors": "ConditionReachedException TimeoutException TimeoutObject timeout_sec_to_nsec",
        "rclpy.executors.Executor": "can_execute spin_once_until_future_complete wait_for_ready_callbacks",
        "rclpy.guard_condition.GuardCondition": "handle",
        "rclpy.logging": "clear_config get_logging_directory initialize shutdown",
        "rclpy.logging.RcutilsLogger": "logger_sublogger_namepair",
        "rclpy.node.Node": """
            add_waitable clients create_rate destroy_rate get_client_names_and_types_by_node
            get_node_names_and_namespaces_with_enclaves get_parameter_type get_parameter_types
            get_publisher_names_and_types_by_node get_publishers_info_by_topic get_service_names_and_types_by_node
            get_subscriber_names_and_types_by_node get_subscriptions_info_by_topic guards handle publishers
            remove_waitable services set_descriptor subscriptions timers waitables
        """,
        "rclpy.parameter": "get_parameter_value parameter_dict_from_yaml_file",
        "rclpy.publisher.Publisher": "assert_liveliness event_handlers handle wait_for_all_acked",
        "rclpy.qos": "QoSPolicyKind qos_check_compatible qos_policy_name_from_kind",
        "rclpy.qos.QoSProfile": "get_c_qos_profile",
        "rclpy.service.Service": "configure_introspection handle",
        "rclpy.signals": "SignalHandlerGuardCondition get_current_signal_handlers_options",
        "rclpy.subscription.Subscription": "CallbackType event_handlers handle",
        "rclpy.timer": "Rate",
        "rclpy.timer.Timer": "handle",
        "rclpy.utilities": "get_available_rmw_implementations timeout_sec_to_nsec",
    }.items()
}


def refuse_absent(owner: str) -> Callable[..., Any]:
    """Return the `__getattr__` of the module or class `owner`.

    It raises NotImplementedError for names that rclpy has there and the embedded runtime does not, and AttributeError
    for all others.
    """
    names = ABSENT.get(owner, frozenset())

    def getattribute(*instance_and_name: Any) -> Any:
        name = instance_and_name[-1]
        if name in names:
            raise needs_ros2(f"{owner}.{name}")
        raise AttributeError(f"'{owner}' has no attribute '{name}'")

    return getattribute
