"""Pictures of a field: B-scans at any position, and en-face views."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.volume import Volume

EnfaceMode = Literal["mip", "mean"]


def bscan_slice(field: Field, position: float) -> NDArray[np.float32]:
    """Return one B-scan of a field, between the acquired ones too.

    Not differentiable; thread-safe; any device.

    Args:
        field: the field to look at.
        position: B-scan index, whole or fractional, from 0 to the number of B-scans less one.

    Returns:
        Intensities [axial, lateral] at the native axial and lateral voxels.

    Raises:
        QueryError: the position lies outside the scan.
    """
    bscans = field.geometry.shape[0]
    if not 0.0 <= position <= bscans - 1:
        raise QueryError(f"bscan_slice: expected a B-scan position from 0 to {bscans - 1}, got {position}")
    return _native_bscan(field, position)


def enface(source: Field | Volume, mode: EnfaceMode = "mip") -> NDArray[np.float32]:
    """Return the view along the beam of a field or a measured volume, at its native lateral voxels.

    A field is evaluated at every voxel, B-scan by B-scan; for a quick view take the volume. Thread-safe; any device.

    Args:
        source: the field or volume to look at.
        mode: "mip" for the largest intensity of each A-scan, "mean" for its mean.

    Returns:
        Intensities [bscan, lateral].

    Raises:
        QueryError: the mode is unknown.
    """
    if mode not in ("mip", "mean"):
        raise QueryError(f"enface: expected the mode mip or mean, got {mode!r}")
    along_beam = np.max if mode == "mip" else np.mean
    if isinstance(source, Volume):
        return along_beam(source.normalized(), axis=1)
    return np.stack([along_beam(_native_bscan(source, index), axis=0) for index in range(source.geometry.shape[0])])


def _native_bscan(field: Field, position: float) -> NDArray[np.float32]:
    bscans, axials, laterals = field.geometry.shape
    lateral, axial, bscan = (
        torch.from_numpy(np.asarray(index * (2.0 / (count - 1)) - 1.0, dtype=np.float32)).to(field.device)
        for index, count in (
            (np.arange(laterals), laterals),
            (np.arange(axials), axials),
            (np.full(1, position), bscans),
        )
    )
    return field.lattice(lateral, axial, bscan)[0].cpu().numpy()
