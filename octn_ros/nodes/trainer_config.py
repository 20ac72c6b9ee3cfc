"""What the trainer has to be told about the scanner, the arm, the files it may read, and where it keeps its field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from octn_ros.errors import ConfigurationError
from octn_ros.field.device import DEVICE_DESCRIPTION
from octn_ros.nodes.field_store import AUTO
from octn_ros.nodes.qos import RELIABILITIES
from octn_ros.settings import check_micrometres, check_settings, setting
from octn_ros.training import PRESETS
from octn_ros.volume import IntensityScale

# What opens the machine to those who can call services is not for them to change.
READ_ONLY = (
    "preset", "device", "bscan_reliability", "data_root", "largest_file_bytes", "largest_scan_voxels", "field_path",
)  # fmt: skip


@dataclass(frozen=True)
class TrainerConfig:
    """The trainer's own settings; those of the fit are `FitConfig`'s. Immutable."""

    preset: str = setting("fast", "preset that the defaults of fit.* come from", choices=tuple(PRESETS))
    device: str = setting("auto", DEVICE_DESCRIPTION)
    bscan_count: int = setting(0, "B-scans of a C-scan on the topic bscan; 0 = not stated, none is taken", low=0)
    spacing_um: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "voxel spacing (bscan, axial, lateral) of the B-scans, and of files that state none; 0 = not stated. The "
        "bscan spacing may stay 0: bscan_pose tells it; where it is stated, the poses are held against it",
        unit="um",
        low=0.0,
    )
    intensity_scale: str = setting(
        "unknown", "what the B-scans' grey values are of the reflected power", choices=("linear", "log", "unknown")
    )
    bscan_reliability: str = setting(
        "reliable", "reliability asked of bscan and bscan_pose; best_effort also hears reliable ones",
        choices=RELIABILITIES,
    )  # fmt: skip
    longest_bscan_wait_s: float = setting(
        5.0, "a C-scan whose next B-scan does not come within this time is given up", unit="s", low=0.01, high=3600.0
    )
    new_scan: str = setting(
        "restart",
        "what a new C-scan does to a running fit. restart: the fit is given up and the new C-scan takes its place; "
        "finish: the fit ends first and its field is published, then the newest C-scan that waits is taken",
        choices=("restart", "finish"),
    )
    warm_start: bool = setting(
        False, "begin the fit of a C-scan with the last fitted field, if the scans agree in shape and spacing"
    )
    largest_pose_gap_s: float = setting(
        0.5, "an ee_pose further than this from the scan's stamp does not count as the scan's", unit="s", low=0.0
    )
    largest_scan_motion_m: float = setting(
        2e-4, "a C-scan during which ee_pose moved further than this is not fitted", unit="m", low=0.0
    )
    largest_scan_rotation_rad: float = setting(
        2e-3, "a C-scan during which ee_pose turned further than this is not fitted", unit="rad", low=0.0
    )
    largest_scan_voxels: int = setting(
        1 << 28, "a C-scan of more voxels is refused: a file's before it is read, the scanner's at B-scan 0", low=8
    )
    data_root: str = setting(
        "", "folder below which load_cscan may read; no link out of it is followed; empty = nothing is read"
    )
    largest_file_bytes: int = setting(
        1 << 31, "load_cscan refuses a file, or a folder of images, larger than this", unit="B", low=1
    )
    field_path: str = setting(
        AUTO,
        "file that keeps the last fitted field, which is published again when the trainer starts; auto = one named "
        "after the node in octn_ros/ under $ROS_HOME (else ~/.ros); empty = none is kept",
    )

    def __post_init__(self) -> None:
        check_settings(self)
        check_micrometres("spacing_um", self.spacing_um)
        bscan, axial, lateral = self.spacing_um
        if bool(axial) != bool(lateral) or (bscan and not axial):
            raise ConfigurationError(
                "spacing_um: expected the axial and the lateral spacing both stated or both 0, and the bscan spacing "
                f"with them or 0, got {self.spacing_um} um"
            )
        if self.bscan_count == 1:
            raise ConfigurationError("bscan_count: expected 0 (not stated) or at least 2 B-scans, got 1")

    @property
    def spacing_m(self) -> tuple[float | None, float, float] | None:
        """Spacing in metres, bscan None where the poses tell it; None if it is not stated."""
        bscan, axial, lateral = (value * 1e-6 for value in self.spacing_um)
        return (bscan or None, axial, lateral) if axial else None

    @property
    def file_spacing_um(self) -> tuple[float, float, float] | None:
        """Spacing for files that state none; None unless all of it is stated."""
        return self.spacing_um if all(self.spacing_um) else None

    @property
    def scale(self) -> IntensityScale:
        """The intensity scale of B-scans."""
        return cast(IntensityScale, self.intensity_scale)  # one of them, as its choices say
