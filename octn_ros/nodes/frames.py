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
        calibration: relates the OCT frame to the end effector.
        ee2base: pose of the end effector in the robot's base at the time of the scan [4, 4], None if unknown.
    """

    calibration: Calibration
    ee2base: NDArray[np.float64] | None = None

    def to_oct(self, pose: PoseStamped) -> NDArray[np.float64]:
        """Return a pose [4, 4] in the OCT frame.

        Raises:
            PlanError: nobody knows the frame.
            CalibrationError: the pose is not a finite, rigid one.
        """
        frame = pose.header.frame_id
        return self._frame2oct(frame) @ pose_to_matrix(pose.pose)

    def _frame2oct(self, frame: str) -> NDArray[np.float64]:
        calibration = self.calibration
        if frame == calibration.oct_frame:
            return np.eye(4)
        ee2oct = invert(calibration.oct2ee)
        if frame == calibration.ee_frame:
            return ee2oct
        if frame == calibration.base_frame and self.ee2base is not None:
            return ee2oct @ invert(self.ee2base)
        known = [calibration.oct_frame, calibration.ee_frame]
        hint = ""
        if self.ee2base is not None:
            known.append(calibration.base_frame)
        elif frame == calibration.base_frame:
            hint = "; the pose of the end effector at the time of the scan (scan_ee_pose) is not known"
        raise PlanError(f"expected a pose in one of the frames {', '.join(known)}, got frame_id {frame!r}{hint}")
