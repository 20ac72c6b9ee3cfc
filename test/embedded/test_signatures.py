"""What we offer has the names and signatures of genuine rclpy (Jazzy), and all the rest says that it needs ROS 2."""

import importlib
import inspect
import json
import os
import re
from pathlib import Path

import pytest
import rclpy
from nav_msgs.srv import GetPlan
from rclpy.clock import Clock
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from octn_ros.embedded.absent import ABSENT, ABSENT_MODULES

ROOT = Path(__file__).parents[2]
API = Path(os.environ.get("OCTN_SHARED", ROOT.parent / "shared")) / "rclpy_jazzy_api.json"
pytestmark = pytest.mark.skipif(not API.exists(), reason=f"no {API}: set OCTN_SHARED to the folder that has it")
INDEX = json.loads(API.read_text())["index"] if API.exists() else {}
CLASSES = {n: entry for n, entry in INDEX.items() if isinstance(entry, dict) and "members" in entry}
FUNCTIONS = {n: entry for n, entry in INDEX.items() if isinstance(entry, str)}
FUNCTIONS.update({f"rclpy.{n}": s for n, s in INDEX.get("rclpy", {}).items() if n[0].islower()})
MADE_BY_NODES = {f"rclpy.{n.lower()}.{n}" for n in ("Publisher", "Subscription", "Client", "Service", "Timer")}
MADE_BY_NODES.add("rclpy.exceptions.NameValidationException")  # raised as one of its subclasses only
LACKING = "**lacking"  # stands for arguments that are refused


def arguments_of(function):
    """The arguments of a function of nodes that are refused."""
    return sorted(next(names for owner, names in ABSENT.items() if owner.endswith(f".{function}")))


def find(name):
    """The module or class `name` if we offer it, else None."""
    module, _, rest = name.rpartition(".")
    try:
        return importlib.import_module(module or rest).__dict__.get(rest)
    except (ImportError, NotImplementedError):
        return None


def genuine_parameters(signature):
    """(name, keyword only, default as text or None) of each parameter in a text such as `(a, *, b: int = 1) -> X`."""
    depth, parts, start = 0, [], 1
    for at, sign in enumerate(signature):
        depth += (sign in "([{<") - (sign in ")]}" or (sign == ">" and signature[at - 1] != "-"))
        if (sign == "," and depth == 1) or (sign == ")" and depth == 0):
            parts.append(signature[start:at].strip())
            start = at + 1
            if depth == 0:
                break
    found, keyword_only = [], False
    for part in filter(None, parts):
        if part in ("*", "/"):
            keyword_only = keyword_only or part == "*"
            continue
        name = re.match(r"[*\w]+", part)[0]
        default = re.search(r"(?:^\w+|\]|\w|'|\.) ?= ?(.*)$", part)
        found.append((name, keyword_only, default[1] if default else None))
        keyword_only = keyword_only or name.startswith("*")
    return [f for f in found if f[0] != "self"]


def our_parameters(function):
    stars = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    return [
        (
            stars.get(p.kind, "") + p.name,
            p.kind == inspect.Parameter.KEYWORD_ONLY,
            None if p.default is p.empty else repr(p.default),
        )
        for p in inspect.signature(function).parameters.values()
        if p.name != "self"
    ]


def assert_same(ours, genuine):
    if LACKING in [p[0] for p in ours]:
        ours = [p for p in ours if p[0] != LACKING]
        genuine = [p for p in genuine if p[0] in {q[0] for q in ours} or p[0] not in set().union(*ABSENT.values())]
    assert [p[0] for p in ours] == [p[0] for p in genuine]
    for (name, ours_keyword, ours_default), (_, keyword, default) in zip(ours, genuine, strict=True):
        if not name.startswith("*"):
            assert ours_keyword == keyword, name
        assert (ours_default is None) == (default is None), name
        if default is not None and not default.startswith("<") and "object at" not in ours_default:
            assert ours_default == default, name


@pytest.mark.parametrize("name", sorted(n for n in FUNCTIONS if inspect.isfunction(find(n))))
def test_functions_have_the_genuine_parameters(name):
    assert_same(our_parameters(find(name)), genuine_parameters(FUNCTIONS[name]))


@pytest.mark.parametrize("name", sorted(n for n in CLASSES if find(n) is not None))
def test_classes_offer_nothing_of_their_own_and_have_the_genuine_parameters(name):
    cls, entry = find(name), CLASSES[name]
    known = set(entry["members"]) | set(entry.get("instance_attributes", ())) | set(entry.get("enum_members", ()))
    public = {n for n in dir(cls) if not n.startswith("_")}
    assert public <= known | {n for base in cls.__mro__ if base.__module__ in ("builtins", "enum") for n in dir(base)}
    for member in sorted(public & set(entry["members"])):
        signature = entry["members"][member].removeprefix("[classmethod] ")
        if signature.startswith("(") and inspect.isroutine(getattr(cls, member)) and member in vars(cls):
            assert_same(our_parameters(getattr(cls, member)), genuine_parameters(signature))
    signature = entry.get("signature")
    called_by_users = "enum_members" not in entry and name not in MADE_BY_NODES
    if isinstance(signature, str) and signature.startswith("(") and called_by_users:
        assert_same(our_parameters(cls), genuine_parameters(signature))


@pytest.mark.parametrize("name", sorted(n for n, e in CLASSES.items() if "enum_members" in e and find(n) is not None))
def test_enumerations_have_the_genuine_values(name):
    cls = find(name)
    assert set(cls.__members__) == set(CLASSES[name]["enum_members"])
    for member, value in CLASSES[name]["enum_members"].items():
        if str(value).isdigit():
            assert cls[member].value == int(value)


@pytest.mark.parametrize("name", sorted(n for n in INDEX if n.startswith("rclpy.qos.qos_profile_") and find(n)))
def test_profiles_have_the_genuine_values(name):
    profile = find(name)
    for policy, value in INDEX[name].items():
        if policy in ABSENT["rclpy.qos.QoSProfile"]:
            continue
        ours = getattr(profile, policy)
        assert str(ours if isinstance(ours, (bool, Duration)) else int(ours)) == str(value)


@pytest.mark.parametrize("module", sorted({n.rpartition(".")[0] for n in INDEX if find(n) is not None} - {""}))
def test_modules_offer_nothing_of_their_own(module):
    ours = importlib.import_module(module)
    made_here = {
        n
        for n, value in vars(ours).items()
        if not n.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__ == module
    }
    known = {n.rpartition(".")[2] for n in INDEX if n.rpartition(".")[0] == module} | set(INDEX.get(module, ()))
    elsewhere = {"SignalHandlerOptions", "parameter_value_to_python"}  # genuine, made in rclpy's C++ or elsewhere
    assert made_here <= known | elsewhere


def refused(owner, name):
    with pytest.raises(NotImplementedError, match="needs ROS 2") as error:
        getattr(owner, name)
    assert name in str(error.value)


@pytest.mark.parametrize("name", sorted(n for n in INDEX if "." in n))
def test_what_we_lack_says_that_it_needs_ros2(name):
    module, _, rest = name.rpartition(".")
    if any(module == m or module.startswith(f"{m}.") for m in ABSENT_MODULES):
        with pytest.raises(NotImplementedError, match="needs ROS 2"):
            importlib.import_module(module)
        return
    owner = importlib.import_module(module)
    if rest not in vars(owner):
        refused(owner, rest)


@pytest.mark.parametrize("name", sorted(ABSENT_MODULES))
def test_modules_we_lack_say_that_they_need_ros2(name):
    with pytest.raises(NotImplementedError, match=f"{name} is not in the embedded runtime: it needs ROS 2"):
        importlib.import_module(name)


def test_members_we_lack_say_that_they_need_ros2(nodes):
    node = nodes("alpha")
    objects = {
        "rclpy.node.Node": node,
        "rclpy.publisher.Publisher": node.create_publisher(String, "a", 1),
        "rclpy.subscription.Subscription": node.create_subscription(String, "a", print, 1),
        "rclpy.client.Client": node.create_client(GetPlan, "b"),
        "rclpy.service.Service": node.create_service(GetPlan, "b", print),
        "rclpy.timer.Timer": node.create_timer(1.0, print),
        "rclpy.callback_groups.CallbackGroup": node.default_callback_group,
        "rclpy.executors.Executor": SingleThreadedExecutor(),
        "rclpy.clock.Clock": Clock(),
        "rclpy.context.Context": Context(),
        "rclpy.duration.Duration": Duration(),
        "rclpy.qos.QoSProfile": QoSProfile(depth=1),
        "rclpy.logging.RcutilsLogger": node.get_logger(),
    }
    for name, owner in objects.items():
        entry = INDEX[name if name in INDEX else "rclpy.impl.rcutils_logger.RcutilsLogger"]
        for member in [*entry["members"], *entry.get("instance_attributes", ())]:
            if not member.startswith("_") and member not in vars(type(owner)) and member not in dir(owner):
                refused(owner, member)


@pytest.mark.parametrize(
    ("function", "name"),
    [(f, n) for f in ("Node()", "create_publisher", "create_subscription") for n in arguments_of(f)],
)
def test_arguments_we_lack_say_that_they_need_ros2(nodes, function, name):
    node = nodes("alpha")
    make = {
        "Node()": lambda **kwargs: nodes("beta", **kwargs),
        "create_publisher": lambda **kwargs: node.create_publisher(String, "a", 1, **kwargs),
        "create_subscription": lambda **kwargs: node.create_subscription(String, "a", print, 1, **kwargs),
    }[function]
    with pytest.raises(NotImplementedError, match=rf"'{name}' .* needs ROS 2"):
        make(**{name: True})
    make(**{name: None})
    with pytest.raises(TypeError, match="unexpected"):
        make(nothing=1)


def test_names_that_rclpy_does_not_have_either_are_plain_errors(nodes):
    assert not hasattr(rclpy, "nothing")
    assert not hasattr(nodes("alpha"), "nothing")
