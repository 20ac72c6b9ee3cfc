"""C-scans in vendors' files through the optional library oct-converter, in a process of its own.

The formats are undocumented and the library trusts what it reads: a damaged file can send it round in circles or ask
for all memory there is. The process has a limit on its memory and on its processor time.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.limits import DEFAULT_MAX_BYTES
from octn_ros.volume.scan_header import RawScan, ReadRequest, ScanHeader

LIBRARY = "oct_converter"
_START_S = 3  # processor time to import the library, with room
_BYTES_PER_S = 20e6  # slower than any of its readers
_START_BYTES = 2**30  # address space of the interpreter with the library's own imports
_COPIES = 3  # of the voxels that a reader holds at once: bytes, array, list of B-scans


def read_vendor(path: Path, request: ReadRequest) -> RawScan:
    """Read Topcon's .fds and .fda, Heidelberg's .e2e, Bioptigen's and Optovue's .oct, and Zeiss's .img.

    Only Topcon's state all three spacings; what the library fills in for others by default is not taken.

    Raises:
        VolumeError: the library is missing, cannot read the file within its limits, or the file holds several volumes
            and `request.variable` names none of them.
    """
    if importlib.util.find_spec(LIBRARY) is None:
        raise VolumeError(
            f"expected the library oct-converter for {path.suffix} files; install it: pip install octn_ros[vendor]"
        )
    with tempfile.TemporaryDirectory(prefix="octn_vendor_") as folder:
        output = Path(folder) / "voxels.npy"
        stated = json.loads(_run(path, request, output))
        shape, dtype = tuple(stated["shape"]), np.dtype(stated["dtype"])
        request.limit.check_array(shape, dtype, path.stat().st_size, compressed=True)
        voxels: NDArray[Any] = np.load(output, allow_pickle=False)
    return RawScan(ScanHeader.from_plain(stated), voxels.shape, voxels.dtype, lambda: voxels)


def _run(path: Path, request: ReadRequest, output: Path) -> str:
    size = path.stat().st_size
    max_bytes = request.limit.max_bytes or min(DEFAULT_MAX_BYTES, 8 * size)
    limits = [str(int(_START_S + size / _BYTES_PER_S)), str(_START_BYTES + _COPIES * max_bytes)]
    variable = ["--variable", request.variable] if request.variable else []
    files = [str(path.resolve()), str(output)]
    command = [sys.executable, "-m", "octn_ros.volume.vendor_process", *files, *limits, *variable]
    done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"]
        raise VolumeError(
            f"oct-converter cannot read the file; it is damaged, or not what {path.suffix} says: {said[-1]}"
        )
    return done.stdout
