"""Tissue with a known truth, and the machines around it: an OCT scanner, a robot arm with a laser."""

from octn_ros.simulation.arm import Arm, ArmConfig, ArmSample, ArmState
from octn_ros.simulation.artefacts import ArtefactConfig
from octn_ros.simulation.interface import Interface
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.named import ADVERSE, NAMED_PHANTOMS, SMOOTH, named_phantom
from octn_ros.simulation.phantom import Phantom, make_phantom
from octn_ros.simulation.phantom_config import PhantomConfig
from octn_ros.simulation.region_snr import RegionSnr, region_snr
from octn_ros.simulation.scanner import BScan, Scanner
from octn_ros.simulation.surface import TissueSurface

__all__ = [
    "ADVERSE",
    "NAMED_PHANTOMS",
    "SMOOTH",
    "Arm",
    "ArmConfig",
    "ArmSample",
    "ArmState",
    "ArtefactConfig",
    "BScan",
    "Interface",
    "LaserPath",
    "Phantom",
    "PhantomConfig",
    "RegionSnr",
    "Scanner",
    "TissueSurface",
    "make_phantom",
    "named_phantom",
    "region_snr",
]
