"""Names of rclpy (Jazzy) that the embedded runtime knows and does not have; their use says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from octn_ros.embedded.errors import needs_ros2

# By module, class or function: the names that are not in it, the arguments that it does not take.
_NAMES = """
    modules: action constants endpoint_info event_handler expand_topic_name experimental guard_condition handle
        impl lifecycle logging_service parameter_client parameter_event_handler qos_event qos_overriding_options
        service_introspection time_source topic_endpoint_info topic_or_service_is_hidden
        type_description_service type_hash type_support validate_full_topic_name validate_namespace
        validate_node_name validate_parameter_name validate_topic_name wait_for_message waitable
    rclpy: create_node get_rmw_implementation_identifier
    rclpy.callback_groups.CallbackGroup: add_entity entities has_entity
    rclpy.client.Client: configure_introspection get_pending_request handle
    rclpy.clock: ClockChange ClockHandle JumpHandle JumpThreshold TimeJump TimeJumpDictionary get_default_context
    rclpy.clock.Clock: create_jump_callback handle set_ros_time_override sleep_for sleep_until
    rclpy.context: ContextHandle
    rclpy.context.Context: destroy get_domain_id handle on_shutdown
    rclpy.duration: Infinite
    rclpy.duration.Duration: from_msg get_c_duration
    rclpy.exceptions: NoTypeSupportImportedException ParameterImmutableException ParameterUninitializedException
        ROSInterruptException
    rclpy.executors: ConditionReachedException ShutdownException TimeoutException TimeoutObject await_or_execute
        timeout_sec_to_nsec
    rclpy.executors.Executor: can_execute create_task spin_once_until_future_complete wait_for_ready_callbacks
    rclpy.logging: clear_config get_logger_level get_logging_directory initialize shutdown
    rclpy.logging.RcutilsLogger: is_enabled_for logger_sublogger_namepair
    rclpy.logging.RcutilsLogger.log: name throttle_time_source_type
    rclpy.node.Node: add_pre_set_parameters_callback add_waitable clients count_clients
        count_services create_guard_condition create_rate destroy_guard_condition destroy_rate
        get_client_names_and_types_by_node get_fully_qualified_node_names get_node_names
        get_node_names_and_namespaces get_node_names_and_namespaces_with_enclaves get_parameter_or
        get_parameter_type get_parameter_types get_publisher_names_and_types_by_node get_publishers_info_by_topic
        get_service_names_and_types get_service_names_and_types_by_node get_subscriber_names_and_types_by_node
        get_subscriptions_info_by_topic get_topic_names_and_types guards handle
        remove_pre_set_parameters_callback remove_waitable
        set_descriptor timers undeclare_parameter waitables
    rclpy.node.Node(): allow_undeclared_parameters automatically_declare_parameters_from_overrides cli_args
        enable_logger_service enable_rosout
    Node.create_publisher: event_callbacks publisher_class qos_overriding_options
    Node.create_subscription: event_callbacks qos_overriding_options
    rclpy.parameter: get_parameter_value parameter_dict_from_yaml_file
    rclpy.publisher.Publisher: assert_liveliness event_handlers handle wait_for_all_acked
    rclpy.qos: LivelinessPolicy QoSLivelinessPolicy QoSPolicyKind QoSPresetProfiles qos_check_compatible
        qos_policy_name_from_kind qos_profile_action_status_default qos_profile_best_available qos_profile_default
        qos_profile_system_default qos_profile_unknown
    rclpy.qos.QoSProfile: avoid_ros_namespace_conventions get_c_qos_profile liveliness liveliness_lease_duration
    rclpy.service.Service: configure_introspection handle
    rclpy.signals: SignalHandlerGuardCondition get_current_signal_handlers_options
    rclpy.subscription.Subscription: CallbackType event_handlers handle
    rclpy.task: Task
    rclpy.timer: Rate
    rclpy.timer.Timer: clock handle is_ready time_since_last_call
    rclpy.utilities: get_available_rmw_implementations get_rmw_implementation_identifier shutdown
        timeout_sec_to_nsec try_shutdown
"""
ABSENT: dict[str, set[str]] = {}
for _word in _NAMES.split():
    if _word.endswith(":"):
        _names = ABSENT[_word[:-1]] = set()
    else:
        _names.add(_word)
ABSENT_MODULES = frozenset(f"rclpy.{name}" for name in ABSENT.pop("modules"))


def refuse_absent(owner: str) -> Callable[..., Any]:
    """Return the `__getattr__` of the module or class `owner`.

    It raises NotImplementedError for names that rclpy has there and the embedded runtime does not, and AttributeError
    for all others.
    """
    names = ABSENT.get(owner, set())

    def getattribute(*instance_and_name: Any) -> Any:
        name = instance_and_name[-1]
        if name in names:
            raise needs_ros2(f"{owner}.{name}")
        raise AttributeError(f"'{owner}' has no attribute '{name}'")

    return getattribute


def refuse_arguments(function: str, given: dict[str, Any]) -> None:
    """Refuse arguments of rclpy that would have no effect here; None and False count as not given.

    Raises:
        NotImplementedError: for the first one that is given.
        TypeError: for one that rclpy does not have either.
    """
    for name, value in given.items():
        if name not in ABSENT[function]:
            raise TypeError(f"{function} got an unexpected keyword argument '{name}'")
        if value is not None and value is not False:
            raise needs_ros2(f"argument '{name}' of {function}")
