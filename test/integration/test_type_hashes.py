"""The embedded runtime's interfaces against those of an installed ROS 2: every type, by its hash."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("rosbags", reason="rosbags, where the embedded runtime has its definitions from, is not installed")

from octn_ros.embedded import definitions
from octn_ros.embedded.finder import PACKAGES

SHARES = [Path(prefix) / "share" for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
KINDS = ("msg", "srv")


def installed(package: str) -> dict[str, str]:
    """Type hashes by name, from the type descriptions that ROS 2 installs beside each interface."""
    files = [file for share in SHARES for kind in KINDS for file in (share / package / kind).glob("*.json")]
    found = {}
    for file in files:
        own = json.loads(file.read_text(encoding="utf-8"))["type_hashes"][0]
        found[own["type_name"]] = own["hash_string"]
    return found


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_hashes_are_those_of_the_installed_ros(package: str) -> None:
    if not (hashes := installed(package)):
        pytest.skip(f"no type descriptions of {package} are installed: ROS 2 is not here")
    offered = [f"{package}/{kind}/{name}" for kind in KINDS for name in definitions.names(package, kind)]
    # The two halves of a service have no file of their own.
    whole = [name for name in offered if not name.endswith(("_Request", "_Response", "_Event"))]
    assert whole
    assert {name: definitions.type_hash(name) for name in whole} == {name: hashes[name] for name in whole}
