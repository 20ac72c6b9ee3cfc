"""The packages of the extra `embedded`, asked for once and clearly."""

from __future__ import annotations

import importlib

REQUIRED = ("zenoh", "rosbags", "numpy", "yaml", "xxhash")


def check_requirements() -> None:
    """Import what the embedded runtime is built on.

    Raises:
        ImportError: one of them is missing; names the command that installs all.
    """
    for name in REQUIRED:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ImportError(
                f"ROS 2 is not installed, and its stand-in lacks the package '{name}': "
                "either source a ROS 2 installation, or pip install 'octn_ros[embedded]'",
                name=name,
            ) from error
