"""What was measured and where it lies: the C-scan, its geometry, files and filters."""

from octn_ros.volume.filters import gaussian_filter
from octn_ros.volume.geometry import OCT_FRAME, VolumeGeometry
from octn_ros.volume.nifti import load_volume, save_volume
from octn_ros.volume.volume import IntensityScale, Volume

__all__ = [
    "OCT_FRAME",
    "IntensityScale",
    "Volume",
    "VolumeGeometry",
    "gaussian_filter",
    "load_volume",
    "save_volume",
]
