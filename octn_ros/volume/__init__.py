"""What was measured and where it lies: the C-scan, its geometry, files and filters."""

from octn_ros.volume.cropping import crop
from octn_ros.volume.description import ScanDescription
from octn_ros.volume.filters import gaussian_filter, gaussian_filter_of_size, median_filter
from octn_ros.volume.geometry import OCT_FRAME, VolumeGeometry
from octn_ros.volume.intensity_scale import to_log_scale
from octn_ros.volume.loading import describe_scan, load_volume
from octn_ros.volume.normalisation import Normalisation
from octn_ros.volume.saving import save_volume
from octn_ros.volume.scan_files import scan_files
from octn_ros.volume.subsampling import SparseScan, subsample_bscans
from octn_ros.volume.volume import IntensityScale, Volume

__all__ = [
    "OCT_FRAME",
    "IntensityScale",
    "Normalisation",
    "ScanDescription",
    "SparseScan",
    "Volume",
    "VolumeGeometry",
    "crop",
    "describe_scan",
    "gaussian_filter",
    "gaussian_filter_of_size",
    "load_volume",
    "median_filter",
    "save_volume",
    "scan_files",
    "subsample_bscans",
    "to_log_scale",
]
