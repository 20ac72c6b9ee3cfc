"""The C-scans in a folder."""

from __future__ import annotations

import os
from pathlib import Path

from octn_ros.errors import VolumeError
from octn_ros.volume.formats import format_suffix
from octn_ros.volume.image_folder import IMAGE_SUFFIXES
from octn_ros.volume.loading import READABLE_SUFFIXES


def scan_files(folder: str | Path) -> list[Path]:
    """Return what `load_volume` would take for a C-scan in a folder and below it, by name alone, in order of the names.

    These are files with the suffix of a format, and folders whose images are B-scans. TIFF files count as B-scans where
    there are several in a folder, and as a scan each where there is one.

    Args:
        folder: where to look; links are not followed into other folders.

    Raises:
        VolumeError: it is no folder.
    """
    root = Path(folder)
    if not root.is_dir():
        raise VolumeError(f"{root}: expected a folder of C-scans")
    found = []
    for place, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths = [Path(place) / name for name in names if not name.startswith(".")]
        images = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
        if len(images) > 1:
            found.append(Path(place))
            paths = [path for path in paths if path not in images]
        found += [path for path in paths if format_suffix(path) in READABLE_SUFFIXES]
    return sorted(found)
