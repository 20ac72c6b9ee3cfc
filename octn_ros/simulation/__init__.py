"""Tissue with a known truth, and the machines around it: an OCT scanner, a robot arm with a laser."""

from octn_ros.simulation.ablation import PhantomTissue
from octn_ros.simulation.arm import Arm, ArmConfig, ArmSample, ArmState
from octn_ros.simulation.artefacts import ArtefactConfig
from octn_ros.simulation.audit import AuditRecord, default_audit_path
from octn_ros.simulation.execution import Execution, ExecutionOrder, Setting
from octn_ros.simulation.inaccuracy import Inaccuracy, InaccuracyConfig
from octn_ros.simulation.interface import Interface
from octn_ros.simulation.interlock import SIGN_OF_LIFE_S, Conditions, InterlockConfig, why_off
from octn_ros.simulation.laser import LaserConfig
from octn_ros.simulation.laser_path import LaserPath
from octn_ros.simulation.named import ADVERSE, NAMED_PHANTOMS, SMOOTH, named_phantom
from octn_ros.simulation.phantom import Phantom, make_phantom
from octn_ros.simulation.phantom_config import PhantomConfig
from octn_ros.simulation.region_snr import RegionSnr, region_snr
from octn_ros.simulation.scanner import BScan, Scanner
from octn_ros.simulation.shots import Shot, ShotSchedule
from octn_ros.simulation.station import Mounting, Station
from octn_ros.simulation.surface import TissueSurface
from octn_ros.simulation.tissue_motion import TissueMotion, TissueMotionConfig
from octn_ros.simulation.trajectory import MotionLimits, Trajectory
from octn_ros.simulation.voucher import Voucher

__all__ = [
    "ADVERSE",
    "NAMED_PHANTOMS",
    "SIGN_OF_LIFE_S",
    "SMOOTH",
    "Arm",
    "ArmConfig",
    "ArmSample",
    "ArmState",
    "ArtefactConfig",
    "AuditRecord",
    "BScan",
    "Conditions",
    "Execution",
    "ExecutionOrder",
    "Inaccuracy",
    "InaccuracyConfig",
    "Interface",
    "InterlockConfig",
    "LaserConfig",
    "LaserPath",
    "MotionLimits",
    "Mounting",
    "Phantom",
    "PhantomConfig",
    "PhantomTissue",
    "RegionSnr",
    "Scanner",
    "Setting",
    "Shot",
    "ShotSchedule",
    "Station",
    "TissueMotion",
    "TissueMotionConfig",
    "TissueSurface",
    "Trajectory",
    "Voucher",
    "default_audit_path",
    "make_phantom",
    "named_phantom",
    "region_snr",
    "why_off",
]
