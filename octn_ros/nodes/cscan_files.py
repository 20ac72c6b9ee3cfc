"""The C-scans that a caller of the graph may have read: below one folder, and not too large."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from urllib.parse import unquote, urlparse

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.volume import Volume, load_volume


class CScanFiles:
    """Finds and reads the C-scans below a root folder; immutable, safe from any thread.

    Links are followed as long as they stay below the root. They are resolved before a file is opened: whoever can
    change what lies below the root while it is read is trusted.

    Args:
        root: the folder, None if nothing may be read.
        largest_bytes: of a file, or of everything in a folder of images.
        largest_voxels: of a C-scan, held against the header before the voxels are read.

    Raises:
        ConfigurationError: the root is no folder.
    """

    def __init__(self, root: Path | None, largest_bytes: int, largest_voxels: int) -> None:
        if root is not None and not root.is_dir():
            raise ConfigurationError(f"data_root: expected an existing folder, or nothing, got {root}")
        self._root = None if root is None else Path(os.path.realpath(root))
        self._largest_bytes, self._largest_voxels = largest_bytes, largest_voxels

    def locate(self, url: str) -> Path:
        """Return the path that a request means; whether anything is there is not looked at.

        Args:
            url: a file:// URL, a path, or a path relative to the root.

        Raises:
            VolumeError: nothing may be read, it is of another machine, or it leads out of the root.
        """
        path = _path_of(url)
        if self._root is None:
            raise VolumeError(
                f"expected the parameter data_root to name the folder that may be read from, got none, and {url!r} "
                "asked for; start the trainer with -p data_root:=FOLDER"
            )
        try:
            found = Path(os.path.realpath(self._root / path))
        except ValueError as error:  # a zero byte in the name
            raise VolumeError(f"expected the path of a C-scan, got {url!r}: {error}") from error
        if not found.is_relative_to(self._root):
            raise VolumeError(f"expected a C-scan below data_root, {self._root}, got {url!r}, which leads out of it")
        return found

    def read(self, path: Path, spacing_um: tuple[float, float, float] | None) -> Volume:
        """Read a C-scan that was located.

        Args:
            path: from `locate`.
            spacing_um: micrometres along (bscan, axial, lateral) for a file that states none.

        Raises:
            VolumeError: it is too large, or cannot be read.
        """
        size = self._size(path)
        if size > self._largest_bytes:
            raise VolumeError(
                f"{path}: expected at most {self._largest_bytes:,} bytes, got {size:,}; cut the scan, or start the "
                "trainer with a larger largest_file_bytes"
            )
        try:
            return load_volume(path, max_voxels=self._largest_voxels)
        except VolumeError:
            # The file's own spacing comes first. If it is for want of it that the file was refused, ours will do;
            # any other fault shows again.
            if spacing_um is None:
                raise
            return load_volume(path, spacing_um, max_voxels=self._largest_voxels)

    def _size(self, path: Path) -> int:
        status = path.stat()
        if stat.S_ISREG(status.st_mode):
            return status.st_size
        if not stat.S_ISDIR(status.st_mode):
            raise VolumeError(f"{path}: expected a file or a folder of images, got neither")
        total = 0
        for entry in path.iterdir():
            target = Path(os.path.realpath(entry))
            if self._root is None or not target.is_relative_to(self._root):
                raise VolumeError(f"{entry}: expected images below data_root, got a link that leads out of it")
            total += entry.stat().st_size if entry.is_file() else 0
        return total


def _path_of(url: str) -> str:
    if not url:
        raise VolumeError("expected the path or file:// URL of a C-scan in map_url, got an empty string")
    parsed = urlparse(url)
    if parsed.scheme == "file" and parsed.netloc in ("", "localhost"):
        return unquote(parsed.path)
    if "://" in url:
        raise VolumeError(f"expected a path or a file:// URL of this machine, got {url!r}")
    return url
