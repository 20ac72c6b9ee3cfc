"""What docs/embedded.md says of security, really done: its blocks are run, and processes talk or are refused."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest
import rclpy
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from rclpy.qos import DurabilityPolicy, QoSProfile

from octn_ros.embedded import session
from octn_ros.embedded.errors import RCLError

PAGE = (Path(__file__).parents[2] / "docs" / "embedded.md").read_text(encoding="utf-8")
BLOCKS = dict(re.findall(r"<!-- test: (\w+) -->\n```sh\n(.*?)```", PAGE, re.DOTALL))
WAIT_SEC = 120.0
REFUSED_SEC = 2.0  # an order of magnitude more than the wait for what is not refused
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def said(process):
    line = process.stdout.readline().strip()
    assert line, process.stderr.read()
    return line


def shell(folder, *names, **variables):
    """Run blocks of the page in a folder and return ZENOH_CONFIG_OVERRIDE as they leave it."""
    script = "\n".join([*(BLOCKS[name] for name in names), 'printf %s "$ZENOH_CONFIG_OVERRIDE"'])
    command = ["bash", "-eu", "-c", script]
    environment = {**os.environ, "ZENOH_CONFIG_OVERRIDE": "", **variables}
    ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """A folder with the certificates of the page, and others of the same names by another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed, with which the page makes certificates")
    folder = tmp_path_factory.mktemp("theatre")
    shell(folder, "certificates")
    stranger = folder / "stranger"
    stranger.mkdir()
    shell(stranger, "certificates")
    return folder


@pytest.fixture
def secured(keys, graph, monkeypatch):
    """Puts the page's settings into the environment: `secured("viewer", "tls")`."""

    def use(name, *blocks, folder="keys"):
        text = shell(keys, *blocks, NAME=name).replace('"keys/', f'"{keys / folder}/')
        monkeypatch.setenv(session.CONFIG_OVERRIDE, text.replace("17447", graph["OCTN_RENDEZVOUS_PORT"]))

    return use


def reached(nodes, spin_until, sec=WAIT_SEC):
    """What a new node gets of the program server.py: (it saw the service, the service answered, latched messages)."""
    node, latched = nodes("asker"), []
    node.create_subscription(PathMessage, "path", latched.append, LATCHED)
    client = node.create_client(GetPlan, "plan")
    seen = client.wait_for_service(sec)
    future = client.call_async(GetPlan.Request())
    end = time.monotonic() + sec
    spin_until(lambda: (future.done() and latched) or time.monotonic() > end, node)
    return seen, future.done(), len(latched)


def test_with_certificates_of_the_authority_processes_talk_as_before(program, secured, nodes, spin_until):
    secured("nodes", "tls")
    assert said(program("server.py")) == "ready"
    assert reached(nodes, spin_until) == (True, True, 1)


def test_without_a_certificate_nobody_joins(program, secured, nodes, spin_until, monkeypatch):
    secured("nodes", "tls")
    assert said(program("server.py")) == "ready"
    monkeypatch.delenv(session.CONFIG_OVERRIDE)
    assert reached(nodes, spin_until, REFUSED_SEC) == (False, False, 0)


def test_certificates_of_another_authority_do_not_help(program, secured, nodes, spin_until):
    secured("nodes", "tls")
    assert said(program("server.py")) == "ready"
    secured("nodes", "tls", folder="stranger/keys")
    assert reached(nodes, spin_until, REFUSED_SEC) == (False, False, 0)


def test_access_control_leaves_the_nodes_alone(program, secured, nodes, spin_until):
    secured("nodes", "tls", "access")
    assert said(program("server.py")) == "ready"
    assert reached(nodes, spin_until) == (True, True, 1)


def test_a_viewer_sees_and_hears_and_calls_nothing(program, secured, nodes, spin_until):
    secured("nodes", "tls", "access")
    assert said(program("server.py")) == "ready"
    secured("viewer", "tls")
    assert reached(nodes, spin_until, REFUSED_SEC) == (True, False, 1)


@pytest.mark.parametrize(("blocks", "speakers"), [(["tls"], {"nodes", "viewer"}), (["tls", "access"], {"nodes"})])
def test_what_a_viewer_publishes_reaches_no_node_with_access_control(
    program, secured, nodes, spin_until, blocks, speakers
):
    secured("viewer", "tls")
    viewer = program("talker.py", "viewer")
    secured("nodes", *blocks)
    node, heard = nodes("listener"), []
    node.create_subscription(PathMessage, "spoken", lambda message: heard.append(message.header.frame_id), 100)
    talker = program("talker.py", "nodes")
    assert [said(process) for process in (viewer, talker)] == ["talking", "talking"]
    assert node.wait_for_node("/talker_viewer", WAIT_SEC)
    spin_until(lambda: heard.count("nodes") >= 20, node)  # both speak ten times a second
    assert set(heard) == speakers


def outside_address():
    """An address of this machine that is not on the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # of no machine; nothing is sent
        except OSError:
            pytest.skip("this machine has no network interface besides loopback")
        return probe.getsockname()[0]


def accepts(address, port):
    with socket.socket() as caller:
        caller.settimeout(WAIT_SEC)
        return caller.connect_ex((address, int(port))) == 0


def test_only_loopback_is_listened_to_unless_told_otherwise(graph, init, monkeypatch, tmp_path):
    address, port = outside_address(), graph["OCTN_RENDEZVOUS_PORT"]
    init()
    assert accepts("127.0.0.1", port)
    assert not accepts(address, port)
    rclpy.shutdown()
    # The names of the page's machines mean nothing here.
    text = re.sub(r', "tcp/\w+-pc:17447"', "", shell(tmp_path, "elsewhere")).replace("17447", port)
    monkeypatch.setenv(session.CONFIG_OVERRIDE, text)
    init()
    assert accepts("127.0.0.1", port)
    assert accepts(address, port)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nonsense/key=1", "nonsense/key=1"),
        ('mode="teapot"', 'mode="teapot"'),
        ("mode", r"expected key=value;key=value, got 'mode'"),
        ("=1", "expected key=value"),
        ("scouting/multicast/enabled=", "expected key=value"),
    ],
)
def test_a_wrong_override_is_refused_with_its_key(init, monkeypatch, text, reason):
    monkeypatch.setenv(session.CONFIG_OVERRIDE, text)
    with pytest.raises(RCLError, match=reason):
        init()


@pytest.mark.parametrize(
    ("text", "pairs"),
    [
        ("", {}),
        (" ;\n; ", {}),
        ('mode="peer"', {"mode": '"peer"'}),
        ('a/b=[1, 2] ;\n c = {x: "=;"};', {"a/b": "[1, 2]", "c": '{x: "=;"}'}),
        ('listen/endpoints=["tcp/[::1]:1#a=b;c=d"]', {"listen/endpoints": '["tcp/[::1]:1#a=b;c=d"]'}),
    ],
)
def test_the_form_of_an_override(monkeypatch, text, pairs):
    monkeypatch.setenv(session.CONFIG_OVERRIDE, text)
    assert session.config_overrides() == pairs


def test_the_page_names_every_variable_and_its_default():
    assert str(session.RENDEZVOUS_PORT) in PAGE
    for name in ("ROS_DOMAIN_ID", "OCTN_RENDEZVOUS_PORT", session.CONFIG_OVERRIDE):
        assert f"`{name}`" in PAGE
