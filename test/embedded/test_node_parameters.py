"""Parameters and their files, ranges and callbacks."""

import pytest
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterEvent,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
)
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from octn_ros.embedded.arguments import Arguments, load
from octn_ros.embedded.errors import RCLError

FILE = """
/**:
  ros__parameters:
    common: 1e5
    when: 12:30
cfg:
  ros__parameters:
    a.b: 3
    nest: {x: [1.0, 2.0], y: "s", on: yes}
/rob/other:
  ros__parameters: {common: 7.0}
/elsewhere:
  ros__parameters: {common: 9.0}
"""


def told(node, name, value):
    return node.set_parameters([Parameter(name, value=value)])[0]


def test_parameter_files_and_arguments(tmp_path, init, nodes):
    path = tmp_path / "params.yaml"
    path.write_text(FILE)
    init("--params-file", str(path), "-p", "cfg:late:=true", "-p", "words:=[a, b]", "-p", "none:=[]")
    node, other = nodes("cfg"), nodes("other", namespace="rob")
    declared = [("common", 0.0), ("a.b", 0), ("nest.x", [0.0]), ("nest.y", ""), ("nest.on", False), ("late", False)]
    assert [node.declare_parameter(n, v).value for n, v in declared] == [1e5, 3, [1.0, 2.0], "s", True, True]
    assert node.declare_parameter("when", "").value == "12:30"
    assert node.declare_parameter("words", [""]).value == ["a", "b"]
    assert node.declare_parameter("none", ["x"]).value == []
    assert node.declare_parameter("nest.z", 1.0, ignore_override=True).value == 1.0
    assert other.declare_parameter("common", 0.0).value == 7.0
    assert other.declare_parameter("late", False).value is False
    assert node.get_parameters_by_prefix("nest")["y"].value == "s"


def test_overrides_given_to_the_node_come_first(init, nodes):
    init("-p", "rate:=1.0")
    node = nodes("alpha", parameter_overrides=[Parameter("rate", value=2.0)])
    assert node.declare_parameters("", [("rate", 0.0)])[0].value == 2.0


def test_a_value_of_another_type_is_refused_at_the_start(init, nodes):
    init("-p", "rate:=1", "-p", "far:=9.0")
    node = nodes("alpha")
    with pytest.raises(InvalidParameterTypeException):
        node.declare_parameter("rate", 1.0)
    limits = FloatingPointRange(from_value=0.0, to_value=5.0)
    with pytest.raises(InvalidParameterValueException, match="out of range"):
        node.declare_parameter("far", 1.0, ParameterDescriptor(floating_point_range=[limits]))
    assert not node.has_parameter("far")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (0.0, ""),
        (5.0, ""),
        (2.5, ""),
        (5.1, "out of range. Min: 0.0, Max: 5.0, value: 5.1"),
        (-0.1, "out of range"),
        (2.4, "not a valid step"),
        (2, "Wrong parameter type, expected 'Type.DOUBLE' got 'Type.INTEGER'"),
        ("x", "Wrong parameter type"),
        (None, "Static parameter cannot be undeclared"),
    ],
)
def test_ranges_and_types_of_numbers(nodes, value, reason):
    node = nodes("alpha")
    limits = FloatingPointRange(from_value=0.0, to_value=5.0, step=0.5)
    node.declare_parameter("x", 1.0, ParameterDescriptor(floating_point_range=[limits]))
    result = told(node, "x", value)
    assert result.successful == (reason == "")
    assert reason in result.reason
    assert node.get_parameter("x").value == (value if result.successful else 1.0)


def test_ranges_of_integers(nodes):
    node = nodes("alpha")
    limits = IntegerRange(from_value=1, to_value=10, step=3)
    node.declare_parameter("n", 4, ParameterDescriptor(integer_range=[limits]))
    assert [told(node, "n", v).successful for v in (1, 7, 8, 10, 11, 0)] == [True, True, False, True, False, False]


def test_read_only_parameters(nodes):
    node = nodes("alpha")
    node.declare_parameter("fixed", 1, ParameterDescriptor(read_only=True))
    assert "read-only" in told(node, "fixed", 2).reason
    assert node.get_parameter("fixed").value == 1


@pytest.mark.parametrize(
    "declaration",
    [
        ("x",),
        ("x", None),
        ("x", Parameter.Type.STRING),
        ("x", 1, ParameterDescriptor(dynamic_typing=True)),
    ],
)
def test_parameters_without_a_fixed_type_and_value_need_ros2(nodes, declaration):
    node = nodes("alpha")
    with pytest.raises(NotImplementedError, match=r"parameter 'x' .* needs ROS 2"):
        node.declare_parameters("", [declaration])
    assert not node.has_parameter("x")


def test_undeclared_parameters(nodes):
    node = nodes("alpha")
    with pytest.raises(ParameterNotDeclaredException):
        node.get_parameter("x")
    with pytest.raises(ParameterNotDeclaredException):
        told(node, "x", 1)
    with pytest.raises(ParameterNotDeclaredException):
        node.describe_parameter("x")
    node.declare_parameter("x", 1)
    with pytest.raises(ParameterAlreadyDeclaredException):
        node.declare_parameter("x", 1)
    with pytest.raises(InvalidParameterException):
        node.declare_parameter("two words", 1)


def test_callbacks_check_what_is_set(nodes):
    node = nodes("alpha")
    node.declare_parameter("x", 1)
    node.declare_parameter("y", 1)

    def check(parameters):
        return SetParametersResult(successful=all(p.value < 10 for p in parameters), reason="too much")

    node.add_on_set_parameters_callback(check)
    assert told(node, "x", 6).successful
    assert told(node, "x", 14).reason == "too much"
    both = [Parameter("x", value=2), Parameter("y", value=12)]
    assert not node.set_parameters_atomically(both).successful
    assert [p.value for p in node.get_parameters(["x", "y"])] == [6, 1]
    node.remove_on_set_parameters_callback(check)
    assert told(node, "x", 70).successful


def test_what_follows_new_values_is_told_once_they_hold_and_not_of_refused_ones(nodes):
    node, heard = nodes("alpha"), []

    def follow(parameters):
        heard.append([(p.name, node.get_parameter(p.name).value) for p in parameters])

    node.add_post_set_parameters_callback(follow)
    node.declare_parameter("x", 1)
    node.add_on_set_parameters_callback(lambda parameters: SetParametersResult(successful=parameters[0].value < 9))
    assert told(node, "x", 2).successful
    assert not told(node, "x", 10).successful
    assert heard == [[("x", 1)], [("x", 2)]]
    node.remove_post_set_parameters_callback(follow)
    assert told(node, "x", 3).successful
    assert len(heard) == 2


def test_parameter_events(nodes, spin_until):
    node, listener, events = nodes("alpha"), nodes("beta"), []
    listener.create_subscription(ParameterEvent, "/parameter_events", events.append, 10)
    node.declare_parameter("x", 1)
    told(node, "x", 2)
    spin_until(lambda: len(events) == 2, listener)
    assert (events[0].node, events[0].new_parameters[0].name) == ("/alpha", "x")
    assert events[1].changed_parameters[0].value.integer_value == 2


def test_listing_with_prefixes_and_depth(nodes):
    node = nodes("alpha")
    for name in ("a", "a.b", "a.b.c", "ab.c"):
        node.declare_parameter(name, 1)
    everything = node.list_parameters([], 0)
    assert set(everything.names) == {"a", "a.b", "a.b.c", "ab.c", "use_sim_time"}
    assert set(everything.prefixes) == {"a", "a.b", "ab"}
    assert set(node.list_parameters(["a"], 0).names) == {"a", "a.b", "a.b.c"}
    assert set(node.list_parameters(["a"], 1).names) == {"a", "a.b"}
    assert set(node.list_parameters([], 1).names) == {"a", "use_sim_time"}


def test_parameters_and_messages():
    for value in (True, 1, 1.5, "x", [True], [1, 2], [1.5], ["x", "y"], [b"\x01"]):
        parameter = Parameter("p", value=value)
        back = Parameter.from_parameter_msg(parameter.to_parameter_msg())
        assert (back.name, back.type_, back.value) == ("p", parameter.type_, value)
    assert Parameter("p").get_parameter_value().type == 0
    with pytest.raises(ValueError, match="do not agree"):
        Parameter("p", Parameter.Type.DOUBLE, 1)
    with pytest.raises(TypeError):
        Parameter("p", value={})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *[("1", 1), ("1e5", 1e5), ("-.5", -0.5), (".inf", float("inf")), ("0x10", 16), ("010", "010"), ("yes", True)],
        *[("2020-01-01", "2020-01-01"), ("12:30", "12:30"), ("[1, 2]", [1, 2]), ("'1'", "1"), ("oct/x", "oct/x")],
    ],
)
def test_yaml_is_read_as_rcl_reads_it(text, value):
    got = load(text)
    assert (got, type(got)) == (value, type(value))


def test_arguments_of_others_are_left_alone():
    argv = ["prog", "pos", "--ros-args", "-p", "a:=1", "--log-level", "warn", "--", "tail"]
    assert remove_ros_args(argv) == ["prog", "pos", "tail"]
    for wrong in (["--nothing", "x"], ["-p"], ["-p", "a"], ["-r", "x:y"]):
        with pytest.raises(RCLError):
            Arguments(["--ros-args", *wrong])
