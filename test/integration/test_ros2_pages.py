"""The commands of the pages' `ros` blocks, as they stand, each in a shell of its own: needs an installed ROS 2."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[2]
PAGES = ("README.md", "docs/connecting.md", "docs/troubleshooting.md", "docs/security.md")
DEMO = "ros2 launch octn_ros demo.launch.py"
# What begins like this is run by the test of that name below.
ASKED = re.compile(r"ros2 (service call|topic echo|topic info|param dump) ")
STARTED = re.compile(r"ros2 (run|launch) octn_ros ((?!--enclave).)*$")
SECURED = re.compile(r"ros2 security |export ROS_SECURITY|ros2 run octn_ros .* --enclave |ROS_SECURITY_")
SET = re.compile(r"export FASTRTPS_")
# What no machine has that these tests run on.
ELSEWHERE = (
    ("device:=cuda", "device:=cpu"),
    ("/data/calibration.yaml", str(REPOSITORY / "config" / "calibration.yaml")),
    ("rviz:=true", "rviz:=false"),
)
NODES = 4
START_SEC, ANSWER_SEC, FIT_SEC, EXIT_SEC = 180.0, 60.0, 180.0, 20.0
SMALL = "-p bscan_count:=24 -p 'spacing_um:=[28.0, 14.59, 14.0]' -p fit.time_budget_s:=2.0 -p device:=cpu"
SCANNED = "-p 'phantom.shape:=[24, 64, 64]' -p phantom.surface:=tilted"

needs_ros2 = pytest.mark.skipif(shutil.which("ros2") is None, reason="ROS 2 is not installed: no ros2 command line")


def _heed_interrupts() -> None:
    """What is started in the background of a script ignores them, and would hand that on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Terminal:
    """A shell with one command, its output kept."""

    def __init__(self, command: str, folder: Path, **environment: str) -> None:
        self.command, self._log = command, folder / f"{time.monotonic_ns()}.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                ["bash", "-c", command],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=REPOSITORY,
                env={**os.environ, "ROS_HOME": str(folder), **environment},
                start_new_session=True,
                preexec_fn=_heed_interrupts,
            )

    @property
    def said(self) -> str:
        return self._log.read_text(encoding="utf-8")

    def until(self, words: str, sec: float, *, times: int = 1) -> None:
        end = time.monotonic() + sec
        while self.said.count(words) < times:
            assert self._process.poll() is None, f"{self.command} has ended: {self.said}"
            assert time.monotonic() < end, f"{words!r} within {sec:g} s, got: {self.said}"
            time.sleep(0.2)

    def ended(self, sec: float) -> int:
        return self._process.wait(sec)

    def interrupt(self) -> None:
        """Press Ctrl-C, and see it end in order."""
        os.killpg(self._process.pid, signal.SIGINT)
        self.ended(EXIT_SEC)
        assert "Traceback" not in self.said, self.said

    def close(self) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


@pytest.fixture(scope="module")
def terminal(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Terminal]]:
    """Give a command to a shell; none outlives the tests."""
    folder, opened = tmp_path_factory.mktemp("terminals"), []

    def run(command: str, **environment: str) -> Terminal:
        opened.append(Terminal(command, folder, **environment))
        return opened[-1]

    yield run
    for one in opened:
        one.close()
    subprocess.run(["ros2", "daemon", "stop"], capture_output=True, check=False)


@pytest.fixture(scope="session")
def ros_commands(shell_blocks: Callable[..., Any], shell_commands: Callable[..., Any]) -> Callable[..., list[str]]:
    """The commands of a page's `ros` blocks that begin as the pattern has it."""

    def found(page: str, pattern: re.Pattern[str]) -> list[str]:
        blocks = [text for mark, text in shell_blocks(REPOSITORY / page) if mark == "ros"]
        return [command for text in blocks for command in shell_commands(text) if pattern.match(command)]

    return found


def answer(terminal: Callable[..., Terminal], command: str) -> str:
    """What a command prints; a service that is not ready yet is asked again, as a person does."""
    if " echo " in command and "--once" not in command:
        follows = terminal(command)
        follows.until("value: done", FIT_SEC)
        follows.interrupt()
        return follows.said
    end = time.monotonic() + ANSWER_SEC
    while True:
        asked = terminal(command)
        assert asked.ended(ANSWER_SEC) == 0, f"{command}: {asked.said}"
        if "success=False" not in asked.said:
            return asked.said
        assert time.monotonic() < end, f"{command}: {asked.said}"


def test_each_command_is_run_by_one_of_these_tests(ros_commands: Callable[..., list[str]]) -> None:
    for page in PAGES:
        for command in ros_commands(page, re.compile("")):
            known = [pattern for pattern in (ASKED, STARTED, SECURED, SET) if pattern.match(command)]
            assert len(known) == 1, f"{page}: nobody runs {command}"


@needs_ros2
def test_what_a_scanner_is_told_to_set_is_there(
    terminal: Callable[..., Terminal], ros_commands: Callable[..., list[str]]
) -> None:
    (export,) = ros_commands("docs/connecting.md", SET)
    shows = terminal(f"{export}\ncat $FASTRTPS_DEFAULT_PROFILES_FILE; echo it says $RMW_FASTRTPS_USE_QOS_FROM_XML")
    assert shows.ended(ANSWER_SEC) == 0, shows.said
    assert "<heartbeatPeriod>" in shows.said
    assert "it says 1\n" in shows.said


@needs_ros2
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_what_is_asked_on_the_pages_is_answered(
    terminal: Callable[..., Terminal], ros_commands: Callable[..., list[str]]
) -> None:
    (launch,) = [command for command in ros_commands("README.md", STARTED) if command.startswith(DEMO)]
    graph = terminal(launch)
    graph.until("ready: ", START_SEC, times=NODES)
    answers: dict[str, str] = {}
    for page in PAGES:
        for command in ros_commands(page, ASKED):
            answers[command] = answer(terminal, command)
            if "/octn/scan " in command:
                graph.until("field fitted", FIT_SEC)  # as README says
    (path,) = [said for command, said in answers.items() if "plan_raster" in command]
    assert path.count("PoseStamped(") > 1000
    for words, expected in (
        ("/octn/waypoints", "orientation:"),
        ("execution_status", "done: "),
        ("plan_status", "field_kind"),
        ("/octn/bscan", "Reliability: RELIABLE"),
        ("param dump", "bscan_count: "),
    ):
        (said,) = [said for command, said in answers.items() if words in command]
        assert expected in said, said
    graph.interrupt()
    assert graph.said.count("process has finished cleanly") == NODES, graph.said


@needs_ros2
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_what_is_started_on_the_pages_starts_and_ends(
    terminal: Callable[..., Terminal], ros_commands: Callable[..., list[str]]
) -> None:
    commands = {command for page in PAGES for command in ros_commands(page, STARTED) if not command.startswith(DEMO)}
    assert len(commands) >= 3
    for command in sorted(commands):
        for theirs, ours in ELSEWHERE:
            command = command.replace(theirs, ours)
        started = terminal(command)
        started.until("ready: ", START_SEC, times=3 if " launch " in command else 1)
        started.interrupt()


@needs_ros2
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_secured_graph_is_made_and_used_as_the_page_says(
    terminal: Callable[..., Terminal], ros_commands: Callable[..., list[str]], tmp_path: Path
) -> None:
    """The trainer is told what the simulator sends, which stands in for a scanner and an arm."""
    pytest.importorskip("sros2", reason="ros2 security is not installed")
    home = {"HOME": str(tmp_path)}
    commands = ros_commands("docs/security.md", SECURED)
    for command in [command for command in commands if command.startswith("ros2 security")]:
        keys = terminal(command, **home)
        assert keys.ended(ANSWER_SEC) == 0, keys.said
    assert "/octn/client" in keys.said, "the last one lists the enclaves"
    (export,) = [command for command in commands if command.startswith("export")]
    nodes = [command for command in commands if "--enclave" in command]
    (trainer,) = [command for command in nodes if " trainer " in command]
    simulator = f"{trainer.replace('trainer', 'simulator')} {SCANNED}"
    graph = [
        terminal(f"{export}\n{command}", **home)
        for command in (f"{trainer} {SMALL}", *[node for node in nodes if node is not trainer], simulator)
    ]
    for started in graph:
        started.until("ready: ", START_SEC)
    (client,) = [command for command in commands if command.startswith("ROS_SECURITY_ENCLAVE_OVERRIDE")]
    used = terminal(f"{export}\n{client.replace('0.3 0.3 3.3 3.3', '0.2 0.15 0.6 0.5')}", **home)
    assert used.ended(FIT_SEC) == 0, used.said
    assert "done: " in used.said, used.said
    stranger = terminal(f"{export}\nros2 run octn_ros planner --ros-args -r __ns:=/octn", **home)
    assert stranger.ended(ANSWER_SEC) != 0
    assert "ready: " not in stranger.said
    for started in graph:
        started.interrupt()
