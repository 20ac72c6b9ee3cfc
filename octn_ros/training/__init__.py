"""Fitting a field to a C-scan: samples, the two-stage fit, presets."""

from octn_ros.training.config import PRESETS, FitConfig
from octn_ros.training.fit import FitProgress, FitResult, fit, psnr_of_field
from octn_ros.training.sampling import VoxelSampler

__all__ = ["PRESETS", "FitConfig", "FitProgress", "FitResult", "VoxelSampler", "fit", "psnr_of_field"]
