"""What the simulator simulates, as parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from octn_ros.nodes.qos import RELIABILITIES
from octn_ros.settings import check_micrometres, check_settings, setting
from octn_ros.simulation import default_audit_path

FIXED = (
    "volume_file",
    "spacing_um",
    "calibration",
    "ee_pose_rate_hz",
    "arm_position_m",
    "arm_orientation",
    "audit_path",
    "bscan_reliability",
)
"""Parameters that can be given at the start only."""


@dataclass(frozen=True)
class SimulatorConfig:
    """What is simulated."""

    volume_file: str = setting("", "C-scan (NIfTI) that the scanner plays; empty = the phantom of phantom.*")
    spacing_um: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "voxel spacing (bscan, axial, lateral) of volume_file in place of its own; 0 = as the file states",
        unit="um",
        low=0.0,
    )
    calibration: str = setting("", "calibration file (YAML); empty = the package's config/calibration.yaml")
    bscan_period_s: float = setting(0.002, "time from one B-scan to the next", unit="s", low=1e-6, high=10.0)
    bscan_factor: int = setting(
        1, "the paper's SF: every so many-th B-scan is acquired, which takes as much less time", low=1, high=64
    )
    bscan_reliability: str = setting(
        "reliable", "reliability of bscan and bscan_pose; a reliable subscriber hears nothing of best_effort ones",
        choices=RELIABILITIES,
    )  # fmt: skip
    ee_pose_rate_hz: float = setting(50.0, "how often ee_pose is published", unit="Hz", low=0.1, high=1000.0)
    arm_position_m: tuple[float, float, float] = setting(
        (0.42, 0.08, 0.30), "where the end effector stands at a scan, in the base frame", unit="m"
    )
    arm_orientation: tuple[float, float, float, float] = setting(
        (1.0, 0.0, 0.0, 0.0), "how it is turned there, quaternion (x, y, z, w); the default points down"
    )
    time_factor: float = setting(1.0, "seconds of the arm's time per second of the clock", low=0.01, high=1e4)
    operator: str = setting(
        "", "who answers for what is executed, for the audit record; ROS services do not know their callers"
    )
    audit_path: str = setting(
        "auto",
        "file that the record of executions is added to; auto = $ROS_HOME/octn_ros/audit.jsonl (ROS_HOME is ~/.ros if "
        "not set), empty = no record",
    )

    def __post_init__(self) -> None:
        check_settings(self)
        check_micrometres("spacing_um", self.spacing_um)

    @property
    def audit_file(self) -> Path | None:
        """The file of the audit record, None if there is to be none."""
        if self.audit_path == "auto":
            return default_audit_path()
        return Path(self.audit_path).expanduser() if self.audit_path else None
