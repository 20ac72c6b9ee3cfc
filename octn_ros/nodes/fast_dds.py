"""What Fast DDS, the default middleware of Jazzy, needs to carry a C-scan whole; loads nothing."""

from __future__ import annotations

import os

from octn_ros.resources import config_path

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
FROM_PROFILES = "RMW_FASTRTPS_USE_QOS_FROM_XML"


def set_up_fast_dds() -> None:
    """Let this process, and those that it starts, use `config/fast_dds.xml` unless the environment says otherwise.

    Read when the process joins the graph, so programs call it before `rclpy.init`. Other middlewares do not read it.
    The file says what it mends.

    Raises:
        ConfigurationError: the file is not where the package was installed.
    """
    if PROFILES not in os.environ and FROM_PROFILES not in os.environ:
        os.environ[PROFILES] = str(config_path("fast_dds.xml"))
        os.environ[FROM_PROFILES] = "1"
