"""Loggers."""

import pytest
from rclpy.clock import Clock
from rclpy.logging import (
    LoggingSeverity,
    get_logger,
    get_logger_effective_level,
    get_logging_severity_from_string,
    set_logger_level,
)


@pytest.fixture(autouse=True)
def usual_levels(monkeypatch):
    # Levels are the process's, as in rclpy: another test may have set them, the demo's for instance.
    monkeypatch.setattr("rclpy.logging._levels", {})


def lines(capsys):
    return capsys.readouterr().err.splitlines()


def test_messages_go_to_stderr_with_severity_time_and_name(capsys):
    logger = get_logger("test.words")
    assert logger.info("hello")
    assert not logger.debug("hidden")
    (line,) = lines(capsys)
    assert line.startswith("[INFO] [")
    assert line.endswith("] [test.words]: hello")


def test_levels_hold_for_loggers_below(capsys):
    set_logger_level("test.level", LoggingSeverity.ERROR)
    child = get_logger("test.level").get_child("child")
    assert not child.warning("hidden")
    assert child.fatal("shown")
    child.set_level(LoggingSeverity.DEBUG)
    assert child.debug("shown")
    assert get_logger_effective_level("test.level") == LoggingSeverity.ERROR
    assert len(lines(capsys)) == 2


def test_once_skip_first_and_throttle(capsys):
    logger = get_logger("test.filters")
    for i in range(3):
        logger.info(f"once {i}", once=True)
        logger.info(f"later {i}", skip_first=True)
        logger.info(f"seldom {i}", throttle_duration_sec=1000.0)
        logger.debug("hidden", once=True)
    texts = [line.rpartition("]: ")[2] for line in lines(capsys)]
    assert texts == ["once 0", "seldom 0", "later 1", "later 2"]
    with pytest.raises(NotImplementedError, match=r"throttle_time_source_type.* needs ROS 2"):
        logger.info("x", throttle_time_source_type=Clock())
    with pytest.raises(TypeError, match="unexpected"):
        logger.info("x", sometimes=True)


def test_names_of_levels(init, capsys):
    init("--log-level", "test.argument:=warn")
    assert not get_logger("test.argument").info("hidden")
    assert get_logging_severity_from_string("error") == LoggingSeverity.ERROR
    with pytest.raises(RuntimeError, match="'loud' is no severity"):
        get_logging_severity_from_string("loud")


def test_a_node_logs_under_its_name_and_to_stderr_only(nodes, capsys):
    node = nodes("alpha", namespace="rob")
    node.get_logger().get_child("part").error("told")
    (line,) = lines(capsys)
    assert line.endswith("] [rob.alpha.part]: told")
    assert not node.count_publishers("/rosout")
