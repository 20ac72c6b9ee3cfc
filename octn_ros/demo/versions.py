"""What a report was made with."""

from __future__ import annotations

import os
import platform
from importlib import metadata

from octn_ros import __version__, embedded


def software_versions() -> dict[str, str]:
    """Return the versions of this package and of what it stands on, the ROS runtime and the machine, by name."""
    versions = {"octn_ros": __version__, "Python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in ("numpy", "torch", "scipy", "matplotlib")}
    if embedded.install():
        versions["ROS runtime"] = f"embedded, on eclipse-zenoh {metadata.version('eclipse-zenoh')}"
    else:
        versions["ROS runtime"] = f"ROS 2 {os.environ.get('ROS_DISTRO', '(distribution not stated)')}"
    versions["machine"] = f"{platform.system()} {platform.machine()}, {os.cpu_count()} logical processors"
    return versions
