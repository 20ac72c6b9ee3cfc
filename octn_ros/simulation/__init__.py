"""Tissue with a known truth, and the machines around it: an OCT scanner, a robot arm with a laser."""

from octn_ros.simulation.arm import Arm, ArmConfig, ArmSample, ArmState
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.phantom import Phantom, PhantomConfig, make_phantom
from octn_ros.simulation.scanner import BScan, Scanner
from octn_ros.simulation.surface import TissueSurface

__all__ = [
    "Arm",
    "ArmConfig",
    "ArmSample",
    "ArmState",
    "BScan",
    "LaserPath",
    "Phantom",
    "PhantomConfig",
    "Scanner",
    "TissueSurface",
    "make_phantom",
]
