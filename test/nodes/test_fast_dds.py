"""The settings of Fast DDS: whom they reach, and that they say what a C-scan needs."""

from __future__ import annotations

import os
import subprocess
import sys
from xml.etree import ElementTree

import pytest

from octn_ros.nodes.fast_dds import FROM_PROFILES, PROFILES, set_up_fast_dds
from octn_ros.resources import config_path

NAMESPACE = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name in (PROFILES, FROM_PROFILES):
        monkeypatch.setenv(name, "")  # whatever a test leaves there is taken away after it
        monkeypatch.delenv(name)
    return monkeypatch


def test_the_settings_are_those_of_the_package(environment: pytest.MonkeyPatch) -> None:
    set_up_fast_dds()
    assert os.environ[PROFILES] == str(config_path("fast_dds.xml"))
    assert os.environ[FROM_PROFILES] == "1"


@pytest.mark.parametrize(("name", "value"), [(PROFILES, "mine.xml"), (FROM_PROFILES, "0")])
def test_settings_of_the_user_stay_alone(environment: pytest.MonkeyPatch, name: str, value: str) -> None:
    environment.setenv(name, value)
    set_up_fast_dds()
    assert {key: os.environ.get(key) for key in (PROFILES, FROM_PROFILES)} == {
        PROFILES: None,
        FROM_PROFILES: None,
        name: value,
    }


def test_they_are_made_before_a_node_can_join_and_only_under_ros2(environment: pytest.MonkeyPatch) -> None:
    program = (
        "import os, octn_ros.nodes; from octn_ros import embedded; "
        f"print(embedded.install(), os.environ.get({PROFILES!r}))"
    )
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert output.split() in (["True", "None"], ["False", str(config_path("fast_dds.xml"))])


@pytest.mark.parametrize("end", ["data_writer", "data_reader"])
def test_no_queue_is_cut_and_losses_are_repaired_soon(end: str) -> None:
    (profile,) = ElementTree.parse(config_path("fast_dds.xml")).getroot().iter(f"{NAMESPACE}{end}")
    said = {element.tag.removeprefix(NAMESPACE): element.text for element in profile.iter()}
    assert profile.get("is_default_profile") == "true"
    assert said["max_samples"] == said["max_samples_per_instance"] == "0"
    assert said["historyMemoryPolicy"] == "DYNAMIC"
    if end == "data_writer":
        assert said["sec"] == "0"
        assert int(said["nanosec"] or 0) <= 50_000_000
