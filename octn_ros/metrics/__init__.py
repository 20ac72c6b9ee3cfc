"""Figures of merit for images, surfaces and paths, on NumPy arrays alone."""

from octn_ros.metrics.image import psnr_db
from octn_ros.metrics.path import hit_rate, smoothness_energy_mm2
from octn_ros.metrics.surface import SurfaceDistance, depth_rms_um, surface_distance

__all__ = ["SurfaceDistance", "depth_rms_um", "hit_rate", "psnr_db", "smoothness_energy_mm2", "surface_distance"]
