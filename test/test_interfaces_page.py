"""docs/interfaces.md and config/sros2/policy.xml say what the nodes do: all of it, and nothing else."""

from __future__ import annotations

import difflib
import re
import runpy
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import rclpy
from rclpy.node import Node

from octn_ros.errors import ConfigurationError
from octn_ros.nodes import interfaces, security_policy
from octn_ros.nodes.every_node import NODES
from octn_ros.nodes.interface_page import interface_page

REPOSITORY = Path(__file__).parents[1]
OURS = re.compile(r"/(octn/|diagnostics|clicked_point|tf)")


@pytest.fixture(scope="module")
def found() -> list[list[interfaces.Interface]]:
    rclpy.init(args=[])
    try:
        return list(interfaces.all_interfaces())
    finally:
        rclpy.try_shutdown()


def assert_same(path: str, text: str, module: str) -> None:
    written = (REPOSITORY / path).read_text(encoding="utf-8")
    difference = "\n".join(difflib.unified_diff(written.splitlines(), text.splitlines(), lineterm="", n=0))
    assert not difference, f"run `python -m octn_ros.nodes.{module} > {path}`:\n{difference}"


def test_the_page_is_the_one_that_the_code_writes(found: list[list[interfaces.Interface]]) -> None:
    assert_same("docs/interfaces.md", interface_page(found), "interface_page")


def test_the_policy_is_the_one_that_the_code_writes(found: list[list[interfaces.Interface]]) -> None:
    assert_same("config/sros2/policy.xml", security_policy.security_policy(found), "security_policy")


def rows() -> dict[str, set[tuple[str, str, str]]]:
    """What the page says of each node: (role, name, type)."""
    page = (REPOSITORY / "docs" / "interfaces.md").read_text(encoding="utf-8")
    said: dict[str, set[tuple[str, str, str]]] = {}
    for section in page.split("\n## ")[1:]:
        node, table = section.split("\n", 1)[0], ""
        for line in section.splitlines()[1:]:
            first, second = ([cell.strip() for cell in line.split("|")[1:3]] + ["", ""])[:2]
            if second == "type":
                table = first
            elif first.startswith("`"):
                said.setdefault(node, set()).add((table, first.strip("`"), second))
    return said


@pytest.fixture
def made(ros: None, monkeypatch: pytest.MonkeyPatch) -> dict[str, set[tuple[str, str, str]]]:
    """What each node that is made in the test makes: (role, name, type), by the calls themselves."""
    made: dict[str, set[tuple[str, str, str]]] = {}

    def note(method: str, title: str, resolve: str) -> None:
        original = getattr(Node, method)

        def wrapped(self: Any, kind: Any, name: str, *rest: Any, **options: Any) -> Any:
            full = getattr(self, resolve)(name)
            if OURS.match(full) and not full.startswith(self.get_fully_qualified_name() + "/"):
                package, group = kind.__module__.split(".")[:2]
                row = title, full.removeprefix("/octn/"), f"{package}/{group}/{kind.__name__}"
                made.setdefault(self.get_name(), set()).add(row)
            return original(self, kind, name, *rest, **options)

        monkeypatch.setattr(Node, method, wrapped)

    note("create_publisher", "Publishes", "resolve_topic_name")
    note("create_subscription", "Subscribes to", "resolve_topic_name")
    note("create_service", "Services", "resolve_service_name")
    return made


def test_the_page_names_each_call_that_makes_a_topic_or_service(made: dict[str, set[tuple[str, str, str]]]) -> None:
    """Held against the calls themselves, not against what the page is written from."""
    for kind in NODES:
        kind().destroy_node()
    said = rows()
    assert said.keys() == made.keys() == {"trainer", "query", "planner", "simulator"}
    for node, entries in made.items():
        assert said[node] == entries, node


@pytest.mark.parametrize(("file", "kind"), [("minimal_scanner", "MinimalScanner"), ("minimal_arm", "MinimalArm")])
def test_a_scanner_and_an_arm_may_do_what_the_examples_do(
    made: dict[str, set[tuple[str, str, str]]], file: str, kind: str
) -> None:
    runpy.run_path(str(REPOSITORY / "examples" / f"{file}.py"))[kind]().destroy_node()
    ((node, entries),) = made.items()
    for title, what, may in (
        ("Publishes", "topic", "publish"),
        ("Subscribes to", "topic", "subscribe"),
        ("Services", "service", "reply"),
    ):
        assert {name for table, name, _ in entries if table == title} <= allowed(f"/octn/{node}", what, may)


def test_a_topic_without_a_meaning_stops_the_page(found: list[list[interfaces.Interface]]) -> None:
    alien = interfaces.Interface("query", interfaces.OFFERS, "guess", "std_srvs/srv/Trigger", None)
    with pytest.raises(ConfigurationError, match="guess"):
        interface_page([*found, [alien]])
    with pytest.raises(ConfigurationError, match="load_cscan"):
        interface_page(found[1:])


def allowed(path: str, what: str, may: str) -> set[str]:
    root = ElementTree.parse(REPOSITORY / "config" / "sros2" / "policy.xml").getroot()
    (profile,) = root.findall(f"./enclaves/enclave[@path='{path}']/profiles/profile")
    assert f"{profile.get('ns')}/{profile.get('node')}" == path
    names = {str(name.text) for rule in profile.findall(f"{what}s[@{may}='ALLOW']") for name in rule.findall(what)}
    return {name for name in names if not name.startswith("~/")} - {"/parameter_events", "/rosout", "/clock"}


def test_each_node_may_do_what_it_does_and_no_more() -> None:
    for node, entries in rows().items():
        names = {
            title: {name for table, name, _ in entries if table == title}
            for title in ("Publishes", "Subscribes to", "Services")
        }
        path = f"/octn/{node}"
        assert allowed(path, "topic", "publish") == names["Publishes"]
        assert allowed(path, "topic", "subscribe") == names["Subscribes to"]
        assert allowed(path, "service", "reply") == names["Services"]
        assert allowed(path, "service", "request") == set()


def test_only_the_operator_may_ask_and_a_viewer_says_nothing() -> None:
    services = {name for entries in rows().values() for table, name, _ in entries if table == "Services"}
    assert services < allowed("/octn/client", "service", "request")
    assert allowed("/octn/client", "topic", "publish") == {"/clicked_point", "query_points"}
    for may in ("reply", "request"):
        assert allowed("/octn/viewer", "service", may) == set()
    assert allowed("/octn/viewer", "topic", "publish") == set()
    assert {"field", "waypoints", "/tf"} < allowed("/octn/viewer", "topic", "subscribe")
    policy = (REPOSITORY / "config" / "sros2" / "policy.xml").read_text(encoding="utf-8")
    assert "*" not in policy
    assert "DENY" not in policy  # it is the default; a rule of it beside ALLOW would only confuse
