"""Files that travel with the package: where its configuration lies, installed or in a source tree."""

from __future__ import annotations

from pathlib import Path

from octn_ros.errors import ConfigurationError


def config_path(name: str) -> Path:
    """Find a file of the package's `config` folder.

    Looks upwards from this module for `share/octn_ros/config` (pip, colcon) and for a source tree (package.xml).

    Args:
        name: the file's name, `calibration.yaml` for instance.

    Raises:
        ConfigurationError: the file is in neither place.
    """
    here = Path(__file__).resolve()
    for parent in here.parents:
        installed = parent / "share" / "octn_ros" / "config" / name
        if installed.is_file():
            return installed
        if (parent / "package.xml").is_file():
            source = parent / "config" / name
            if source.is_file():
                return source
            break  # a source tree without the file: nothing above it is ours
    raise ConfigurationError(
        f"expected config/{name} beside the package or in share/octn_ros/config, found neither from {here.parent}; "
        "install the package again, or name the file yourself"
    )
