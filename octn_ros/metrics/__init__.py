"""Figures of merit for images, surfaces and paths, on NumPy arrays alone."""

from octn_ros.metrics.image import SSIM_PARAMETERS, SSIM_WINDOW, psnr_db, psnr_from_error_db, ssim
from octn_ros.metrics.noise import edge_preservation_index, snr_db, snr_from_moments_db
from octn_ros.metrics.path import hit_rate, smoothness_energy_mm2
from octn_ros.metrics.point_cloud import MAX_POINTS, CloudDistance, chamfer_m, cloud_distance, hausdorff_m
from octn_ros.metrics.region import RegionKind, RegionOfInterest, air_and_tissue, find_regions, load_regions
from octn_ros.metrics.surface import (
    SurfaceDistance,
    summarise_distance,
    surface_distance,
)

__all__ = [
    "MAX_POINTS",
    "SSIM_PARAMETERS",
    "SSIM_WINDOW",
    "CloudDistance",
    "RegionKind",
    "RegionOfInterest",
    "SurfaceDistance",
    "air_and_tissue",
    "chamfer_m",
    "cloud_distance",
    "edge_preservation_index",
    "find_regions",
    "hausdorff_m",
    "hit_rate",
    "load_regions",
    "psnr_db",
    "psnr_from_error_db",
    "smoothness_energy_mm2",
    "snr_db",
    "snr_from_moments_db",
    "ssim",
    "summarise_distance",
    "surface_distance",
]
