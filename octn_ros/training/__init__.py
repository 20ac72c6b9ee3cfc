"""Fitting a field to a C-scan: samples, the two-stage fit, presets."""

from octn_ros.training.config import PRESETS, FitConfig
from octn_ros.training.fit import Ended, FitResult, fit
from octn_ros.training.held_in import psnr_of_field
from octn_ros.training.progress import FitProgress
from octn_ros.training.sampling import ResidentVoxels, VoxelSampler

__all__ = [
    "PRESETS",
    "Ended",
    "FitConfig",
    "FitProgress",
    "FitResult",
    "ResidentVoxels",
    "VoxelSampler",
    "fit",
    "psnr_of_field",
]
