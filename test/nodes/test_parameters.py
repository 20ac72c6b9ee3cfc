from collections.abc import Iterator
from dataclasses import dataclass
from dataclasses import field as dataclass_field

import pytest
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from octn_ros.errors import ConfigurationError
from octn_ros.nodes.parameters import ConfigParameters, undeclared_parameters
from octn_ros.settings import check_settings, setting


@dataclass(frozen=True)
class Inner:
    count: int = setting(3, "how many", low=1, high=9)
    sizes: tuple[int, ...] = setting((1, 2), "sizes", unit="voxels", low=1)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class Outer:
    inner: Inner = dataclass_field(default_factory=Inner)
    length_m: float = setting(0.5, "a length", unit="m", low=0.0)
    mode: str = setting("a", "a mode", choices=("a", "b"))
    flag: bool = setting(False, "a flag")

    def __post_init__(self) -> None:
        check_settings(self)
        if self.flag and self.mode == "b":
            raise ConfigurationError("expected mode a with the flag, got b")


@pytest.fixture
def node(ros: None) -> Iterator[Node]:
    node = Node("parameters", namespace="octn")
    yield node
    node.destroy_node()


def overridden(**values: object) -> Node:
    overrides = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    return Node("overridden", parameter_overrides=overrides)


def test_defaults_come_back_as_the_same_configuration(node: Node) -> None:
    parameters = ConfigParameters(node, Outer(), "plan")
    assert parameters.config() == Outer()
    assert node.get_parameter("plan.inner.count").value == 3
    assert list(node.get_parameter("plan.inner.sizes").value) == [1, 2]


def test_what_is_set_together_is_read_together(node: Node) -> None:
    parameters = ConfigParameters(node, Outer())
    assert parameters.config() is parameters.config(), "not put together anew while values change"
    set_to = [Parameter("length_m", value=0.25), Parameter("inner.count", value=5), Parameter("mode", value="b")]
    assert node.set_parameters_atomically(set_to).successful
    assert parameters.config() == Outer(Inner(count=5), 0.25, "b")
    assert not node.set_parameters_atomically(
        [Parameter("length_m", value=0.1), Parameter("flag", value=True)]
    ).successful
    assert parameters.config() == Outer(Inner(count=5), 0.25, "b")


def test_whoever_asked_is_told_of_a_change_once_it_can_be_read(node: Node) -> None:
    told: list[Outer] = []
    parameters = ConfigParameters(node, Outer(), "plan", changed=lambda: told.append(parameters.config()))
    ConfigParameters(node, Outer(), "other")
    node.set_parameters([Parameter("other.length_m", value=0.25), Parameter("plan.length_m", value=-1.0)])
    assert told == []
    node.set_parameters([Parameter("plan.length_m", value=0.25)])
    assert told == [Outer(length_m=0.25)]


def test_descriptors_say_what_the_settings_say(node: Node) -> None:
    ConfigParameters(node, Outer(), read_only=("flag",))
    length = node.describe_parameter("length_m")
    assert length.description == "a length [m]"
    assert length.floating_point_range[0].from_value == 0.0
    count = node.describe_parameter("inner.count")
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 9)
    assert "one of a, b" in node.describe_parameter("mode").additional_constraints
    assert node.describe_parameter("flag").read_only
    assert not count.read_only


def test_a_value_set_is_in_the_next_configuration(node: Node) -> None:
    parameters = ConfigParameters(node, Outer())
    results = node.set_parameters([Parameter("inner.sizes", value=[4, 5, 6]), Parameter("length_m", value=2.0)])
    assert all(result.successful for result in results)
    assert parameters.config().inner.sizes == (4, 5, 6)
    assert parameters.config().length_m == 2.0


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("mode", "c", "expected one of a, b"),
        ("inner.sizes", [0], "at least 1"),
        ("inner.count", 10, "range"),
        ("length_m", float("nan"), "range"),
        ("length_m", 1, "type"),
    ],
)
def test_a_bad_value_is_refused_with_the_reason(node: Node, name: str, value: object, reason: str) -> None:
    parameters = ConfigParameters(node, Outer())
    result = node.set_parameters([Parameter(name, value=value)])[0]
    assert not result.successful
    assert reason in result.reason
    assert parameters.config() == Outer()


def test_values_that_do_not_fit_together_are_refused(node: Node) -> None:
    parameters = ConfigParameters(node, Outer())
    together = [Parameter("flag", value=True), Parameter("mode", value="b")]
    result = node.set_parameters_atomically(together)
    assert not result.successful
    assert "expected mode a with the flag" in result.reason
    assert node.set_parameters([together[0]])[0].successful
    assert parameters.config().flag


def test_read_only_ones_keep_the_value_of_the_start(ros: None) -> None:
    node = overridden(mode="b")
    parameters = ConfigParameters(node, Outer(), read_only=True)
    assert parameters.config().mode == "b"
    result = node.set_parameters([Parameter("mode", value="a")])[0]
    assert not result.successful
    assert "read-only" in result.reason
    node.destroy_node()


def test_what_is_left_out_is_no_parameter(node: Node) -> None:
    parameters = ConfigParameters(node, Outer(), leave_out=("mode", "inner.count"))
    assert not node.has_parameter("mode")
    assert not node.has_parameter("inner.count")
    assert parameters.config() == Outer()


def test_a_bad_start_is_an_error(ros: None) -> None:
    for values, error in (
        ({"length_m": -1.0}, InvalidParameterValueException),
        ({"length_m": "long"}, InvalidParameterTypeException),
        ({"mode": "c"}, ConfigurationError),
        ({"flag": True, "mode": "b"}, ConfigurationError),
    ):
        node = overridden(**values)
        with pytest.raises(error):
            ConfigParameters(node, Outer())
        node.destroy_node()


def test_two_configurations_share_a_node(node: Node) -> None:
    first, second = ConfigParameters(node, Outer()), ConfigParameters(node, Inner(), "other")
    assert node.set_parameters([Parameter("other.count", value=5)])[0].successful
    assert (first.config().inner.count, second.config().count) == (3, 5)


def test_what_is_given_and_not_declared_is_told_with_the_nearest_name(ros: None) -> None:
    given = [Parameter("linespacing_m", value=1e-4), Parameter("qqq", value=1), Parameter("use_sim_time", value=False)]
    made = Node("misspelt", parameter_overrides=given)
    try:
        made.declare_parameter("line_spacing_m", 5e-5)
        assert undeclared_parameters(made) == ["linespacing_m (did you mean line_spacing_m?)", "qqq"]
    finally:
        made.destroy_node()
