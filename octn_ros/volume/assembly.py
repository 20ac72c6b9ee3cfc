"""A C-scan put together from B-scan images as they arrive, each placed by the pose of its image frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import VolumeError
from octn_ros.volume.bscan_places import BScanPlaces
from octn_ros.volume.geometry import VolumeGeometry
from octn_ros.volume.volume import IntensityScale, Volume

_LEAST_STEPS = 3  # from one B-scan to the next: what fewer take is no time that a C-scan takes
_DTYPES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


class CScanAssembler:
    """Assembles C-scans from B-scans in order, one after another; not thread-safe, keeps one C-scan in memory.

    The OCT frame's origin is the centre of the first voxel of B-scan 0, so the index of a B-scan is its y over the
    step from one to the next. B-scan 0 begins a C-scan. A B-scan that does not fit drops the partial C-scan: `add`
    raises once, and the rest of that C-scan is then left aside without a further error until a B-scan 0 arrives.
    Where the end of one C-scan and as much of the beginning of the next were lost, the numbers alone show no gap; the
    stamps do.

    The voxels are allocated once, when B-scan 0 comes, and become those of the Volume: each image is copied once.

    Args:
        bscan_count: number of B-scans in a C-scan, at least 2.
        spacing_m: metres between voxel centres along (bscan, axial, lateral). bscan None: the poses tell it.
        intensity_scale: what the voxel values mean, written into the Volume.
        largest_voxels: C-scans of more voxels are refused at their first B-scan; None for any.
        room: gives memory for the voxels of a shape and type, where whoever will use them wants them to lie.

    Raises:
        VolumeError: the count is below 2, or a spacing is not positive.
    """

    def __init__(
        self,
        bscan_count: int,
        spacing_m: tuple[float | None, float, float],
        intensity_scale: IntensityScale = "unknown",
        *,
        largest_voxels: int | None = None,
        room: Callable[[tuple[int, int, int], np.dtype[Any]], NDArray[Any]] = np.empty,
    ) -> None:
        along, axial, lateral = spacing_m
        VolumeGeometry((bscan_count, 2, 2), (1.0 if along is None else along, axial, lateral))
        self._count = bscan_count
        self._in_plane_m = axial, lateral
        self._scale = intensity_scale
        self._largest = largest_voxels
        self._room = room
        self._places = BScanPlaces(bscan_count, spacing_m)
        self._voxels: NDArray[Any] | None = None
        self._received = 0
        self._form = ""
        self._stamps_ns: list[int] = []
        self._aside = False

    @property
    def received(self) -> int:
        """Number of B-scans of the present C-scan, 0 when none has begun."""
        return self._received

    @property
    def last_stamp_ns(self) -> int:
        """Acquisition time of the last B-scan that was taken, 0 before the first."""
        return self._stamps_ns[-1] if self._stamps_ns else 0

    def add(self, image: NDArray[Any], image2oct: NDArray[np.floating], stamp_ns: int, form: str = "") -> Volume | None:
        """Take the next B-scan.

        Args:
            image: intensities [axial, lateral] of uint8, uint16 or float32; copied.
            image2oct: pose of the image frame in the OCT frame, 4x4, metres.
            stamp_ns: acquisition time in nanoseconds.
            form: in which frame and layout the image was sent, in words; all of a C-scan must agree.

        Returns:
            The C-scan with the stamp of its B-scan 0 when this B-scan completes it, else None.

        Raises:
            VolumeError: names the index of a B-scan of another size, type, form, direction or place, out of order,
                repeated or late, and of those missing before it; or the C-scan would have too many voxels; or the
                complete C-scan is not a usable Volume. The partial C-scan is dropped. Where B-scan 0 interrupts a
                C-scan, the new one has begun nevertheless.
        """
        pose = np.asarray(image2oct, dtype=np.float64)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            self._drop(f"expected a finite 4x4 pose of the B-scan, got {pose.tolist()}")
        if self._aside and not self._places.begins(pose):
            return None
        try:
            index = self._places.index(pose)
        except VolumeError as error:
            self._drop(str(error))
        if index == 0:
            interrupted = self._received
            self._begin(image, pose, stamp_ns, form)
            if interrupted:
                raise VolumeError(
                    f"expected B-scan {interrupted} of {self._count}, got B-scan 0; "
                    f"the C-scan of {interrupted} B-scans is dropped and a new one has begun"
                )
            return None
        if self._voxels is None:
            self._drop(f"expected B-scan 0, which begins a C-scan, got B-scan {index}; waiting for a B-scan 0")
        self._check(index, self._voxels[0], image, stamp_ns, form)
        self._voxels[index] = image
        self._places.take(pose)
        self._received += 1
        self._stamps_ns.append(stamp_ns)
        return self._finish(self._voxels) if self._received == self._count else None

    def give_up(self) -> str | None:
        """Drop the partial C-scan, for no further B-scan will come; return what is missing, None if nothing is."""
        if not self._received:
            return None
        missing, last = self._received, self._count - 1
        self._forget()
        return f"expected B-scan {missing} of {self._count}, none came; missing: " + (
            f"{missing}" if missing == last else f"{missing} to {last}"
        )

    def _begin(self, image: NDArray[Any], pose: NDArray[np.float64], stamp_ns: int, form: str) -> None:
        self._forget()
        if image.ndim != 2 or min(image.shape) < 2 or image.dtype not in _DTYPES:
            self._drop(
                "B-scan 0: expected an image [axial, lateral] of at least 2 x 2 uint8, uint16 or float32, "
                f"got {image.shape} of {image.dtype}"
            )
        shape = (self._count, image.shape[0], image.shape[1])
        if self._largest is not None and math.prod(shape) > self._largest:
            self._drop(
                f"B-scan 0: expected C-scans of at most {self._largest:,} voxels, got the first of "
                f"{' x '.join(map(str, shape))} = {math.prod(shape):,}; raise the limit if there is memory for them"
            )
        self._voxels = self._room(shape, image.dtype)
        self._voxels[0] = image
        self._received, self._form = 1, form
        self._places.take(pose)
        self._stamps_ns = [stamp_ns]
        self._aside = False

    def _check(self, index: int, first: NDArray[Any], image: NDArray[Any], stamp_ns: int, form: str) -> None:
        if index < self._received:
            self._drop(f"expected B-scan {self._received} of {self._count}, got B-scan {index} again")
        if index > self._received:
            missing = f"{self._received}" if index == self._received + 1 else f"{self._received} to {index - 1}"
            self._drop(
                f"expected B-scan {self._received} of {self._count}, got B-scan {index}; missing: {missing}"
                f"{self._places.why_missing(index)}"
            )
        if image.shape != first.shape or image.dtype != first.dtype:
            self._drop(
                f"B-scan {index}: expected {first.shape} of {first.dtype} as in B-scan 0, "
                f"got {image.shape} of {image.dtype}"
            )
        if form != self._form:
            self._drop(f"B-scan {index}: expected an image sent as B-scan 0 was ({self._form}), got one {form}")
        if stamp_ns < self.last_stamp_ns:
            self._drop(
                f"B-scan {index}: expected a stamp of at least {self.last_stamp_ns} ns, that of B-scan {index - 1}, "
                f"got {stamp_ns} ns; it belongs to an older C-scan"
            )

    def _check_pace(self) -> None:
        """Refuse a C-scan whose B-scans are of two: between them lies the time of a whole C-scan."""
        steps_ns = np.diff(self._stamps_ns)
        last = int(steps_ns.argmax())
        longest_ns, others_ns = int(steps_ns[last]), int(steps_ns.sum() - steps_ns[last])
        if not others_ns:
            return
        # A scanner whose stamps are those of a busy computer may pause, but hardly for longer than it scans, or than
        # three steps where it scans less. Between two C-scans lie three steps more than all others together.
        steps = len(steps_ns) - 1
        counted = max(steps, _LEAST_STEPS)
        most_ns = others_ns * counted // steps
        if longest_ns > most_ns:
            others = "all" if counted == steps else str(counted)
            self._drop(
                f"B-scan {last + 1}: expected a stamp nearer to that of B-scan {last} than the {most_ns * 1e-6:.6g} ms "
                f"that {others} others take, got one {longest_ns * 1e-6:.6g} ms after it; they are of two C-scans"
            )

    def _finish(self, voxels: NDArray[Any]) -> Volume:
        self._check_pace()
        along, origin_m, stamp_ns = self._places.step_m, self._places.origin_m, self._stamps_ns[0]
        # Forgotten first: whatever the Volume says of the voxels, this C-scan is over.
        self._forget()
        assert along is not None  # two B-scans have told it
        spacing_m = along, *self._in_plane_m
        return Volume.from_array(voxels, spacing_m, intensity_scale=self._scale, origin_m=origin_m, stamp_ns=stamp_ns)

    def _forget(self) -> None:
        self._voxels, self._received = None, 0
        self._places.forget()

    def _drop(self, reason: str) -> NoReturn:
        self._forget()
        self._aside = True
        raise VolumeError(reason)
