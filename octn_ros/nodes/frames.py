"""The frames in which a request may be stated, and the way from them into the OCT frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray

from octn_ros.errors import PlanError
from octn_ros.nodes.conversions import pose_to_matrix
from octn_ros.planning import Calibration, invert


@dataclass(frozen=True)
class ScanFrames:
    """What is known about space at the time of one scan; immutable.

    Attributes:
        calibration: relates the OCT frame and the laser frame to the end effector.
        ee2base: pose of the end effector in the robot's base at the time of the scan [4, 4], None if unknown.
        scan_frame: the scan's own OCT frame, None for that of the calibration. Of another one the calibration says
            nothing, so there is no way into it from any frame but itself.
    """

    calibration: Calibration
    ee2base: NDArray[np.float64] | None = None
    scan_frame: str | None = None

    def to_oct(self, pose: PoseStamped) -> NDArray[np.float64]:
        """Return a pose [4, 4] in the OCT frame.

        Raises:
            PlanError: nobody knows the frame, or the calibration is for another scanner.
            CalibrationError: the pose is not a finite, rigid one.
        """
        return self.frame2oct(pose.header.frame_id) @ pose_to_matrix(pose.pose)

    def frame2oct(self, frame: str) -> NDArray[np.float64]:
        """Return the transform [4, 4] of points of a named frame, as it lay at the time of the scan, into the OCT's.

        Raises:
            PlanError: nobody knows the frame, or the calibration is for another scanner.
        """
        calibration = self.calibration
        if self.scan_frame not in (None, calibration.oct_frame):
            if frame == self.scan_frame:
                return np.eye(4)
            raise PlanError(
                f"expected a field in the calibrated frame {calibration.oct_frame!r}, got {self.scan_frame!r}; ask in "
                f"that frame instead of {frame!r}, or load the calibration of that scanner"
            )
        ee2oct = invert(calibration.oct2ee)
        known = {
            calibration.oct_frame: np.eye(4),
            calibration.ee_frame: ee2oct,
            calibration.laser_frame: ee2oct @ calibration.laser2ee,
        }
        if self.ee2base is not None:
            known[calibration.base_frame] = ee2oct @ invert(self.ee2base)
        if frame in known:
            return known[frame]
        hint = ""
        if frame == calibration.base_frame:
            hint = "; the pose of the end effector at the time of the scan (scan_ee_pose) is not known"
        raise PlanError(f"expected one of the frames {', '.join(known)}, got frame_id {frame!r}{hint}")
