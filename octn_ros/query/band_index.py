"""What a field's voxels say, kept for the next question: its samples, and the least and the greatest of each block."""

from __future__ import annotations

import threading
import weakref

import numpy as np
from numpy.typing import NDArray

from octn_ros.field import Field
from octn_ros.query.lattice import SLAB_POINTS, Lattice

# Voxels of a block along every axis.
BLOCK = 8
# A larger scan is asked anew each time: its samples would take more than 1 GiB. While a question on the last field is
# still being answered, its index lives beside that of the new one: 2 GiB at most, for one such change.
LARGEST_INDEX = 1 << 28

Box = tuple[slice, slice, slice]


class BandIndex:
    """Samples of a field at its voxels and their extremes in blocks of 8 x 8 x 8; thread-safe.

    Sampled, not bounded: between the voxels of a block a neural field may leave its range, so the index answers for
    the voxels alone, and for them exactly. Filled as it is asked, block by block; a question about blocks that are
    known touches the field no more. Takes 4 bytes for each voxel of a known block and 8 for each block.

    Args:
        field: the field; not kept alive by its index.
    """

    def __init__(self, field: Field) -> None:
        self._field = weakref.ref(field)
        self._lattice = Lattice.over(field.geometry, name="band index")
        self._filling = threading.Lock()
        shape = self._lattice.shape
        blocks = tuple(-(-size // BLOCK) for size in shape)
        # Pages of memory that nothing is written to take none.
        self._samples: NDArray[np.float32] = np.empty(shape, np.float32)
        self._least: NDArray[np.float32] = np.empty(blocks, np.float32)
        self._greatest: NDArray[np.float32] = np.empty(blocks, np.float32)
        self._known: NDArray[np.bool_] = np.zeros(blocks, np.bool_)

    @classmethod
    def of(cls, field: Field) -> BandIndex:
        """Return the index of a field, the same at every call and for every thread; empty at first.

        It lives as long as the field.
        """
        with _MAKING:
            index = _INDICES.get(field)
            if index is None:
                index = _INDICES[field] = cls(field)
        return index

    @property
    def nbytes(self) -> int:
        """Bytes that the known blocks take."""
        return int(np.count_nonzero(self._known)) * (BLOCK**3 * self._samples.itemsize + 2 * self._least.itemsize)

    def fill(self) -> None:
        """Ask the field at every voxel that is not known yet."""
        for planes in self._lattice.slabs():
            self.samples((planes, slice(0, self._samples.shape[1]), slice(0, self._samples.shape[2])))

    def samples(self, box: Box) -> NDArray[np.float32]:
        """Return the samples [bscan, axial, lateral] in a box of voxels, read-only; asks for those not known yet.

        Args:
            box: voxels along (bscan, axial, lateral), starts and stops within the scan.
        """
        with self._filling:
            unknown = np.argwhere(~self._known[_blocks_of(box)])
            if len(unknown):
                corner = np.array([part.start for part in _blocks_of(box)])
                self._fill(corner + unknown.min(axis=0), corner + unknown.max(axis=0) + 1)
        view = self._samples[box]
        view.flags.writeable = False
        return view

    def matching(self, box: Box, low: np.float32, high: np.float32, half_open: bool) -> NDArray[np.bool_]:
        """Return which blocks [bscan, axial, lateral] that a known box touches can hold a sample of a band.

        Args:
            box: as for `samples`, which was called before.
            low: lowest intensity.
            high: highest intensity, left out if `half_open`.
            half_open: whether.
        """
        least, greatest = self._least[_blocks_of(box)], self._greatest[_blocks_of(box)]
        return np.asarray((greatest >= low) & ((least < high) if half_open else (least <= high)))

    def _fill(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> None:
        """Ask for the unknown ones of the blocks from `first` to `last` along each axis, some planes at a time."""
        field = self._field()
        assert field is not None
        shape = np.array(self._lattice.shape)
        start, stop = first * BLOCK, np.minimum(last * BLOCK, shape)
        plane = int(np.prod((stop - start)[1:]))
        layers = max(1, SLAB_POINTS // (plane * BLOCK))
        for layer in range(int(first[0]), int(last[0]), layers):
            end = min(layer + layers, int(last[0]))
            begin = np.array([layer * BLOCK, *start[1:]])
            beyond = np.array([min(end * BLOCK, shape[0]), *stop[1:]])
            box = tuple(slice(int(a), int(b)) for a, b in zip(begin, beyond, strict=True))
            whole = self._lattice
            bscan, axial, lateral = whole.bscan[box[0]], whole.axial[box[1]], whole.lateral[box[2]]
            values = Lattice(field.geometry, bscan, axial, lateral, native=True).evaluate(field)
            blocks = slice(layer, end), slice(int(first[1]), int(last[1])), slice(int(first[2]), int(last[2]))
            self._keep(values, begin, blocks)

    def _keep(self, values: NDArray[np.float32], begin: NDArray[np.intp], blocks: Box) -> None:
        """Take over samples of whole blocks, but for those that are known: others may be reading them."""
        least, greatest = values, values
        for axis in range(3):
            starts = np.arange(0, values.shape[axis], BLOCK)
            # A sample that is no number lies in no band, and must not hide the others of its block.
            least = np.fmin.reduceat(least, starts, axis=axis)
            greatest = np.fmax.reduceat(greatest, starts, axis=axis)
        known = self._known[blocks]
        if known.any():
            for block in np.argwhere(~known):
                inside = tuple(slice(corner, corner + BLOCK) for corner in block * BLOCK)
                outside = tuple(slice(corner, corner + BLOCK) for corner in begin + block * BLOCK)
                self._samples[outside] = values[inside]
        else:
            self._samples[
                tuple(slice(corner, corner + size) for corner, size in zip(begin, values.shape, strict=True))
            ] = values
        self._least[blocks], self._greatest[blocks] = least, greatest
        self._known[blocks] = True


def _blocks_of(box: Box) -> Box:
    first, second, third = (slice(side.start // BLOCK, -(-side.stop // BLOCK)) for side in box)
    return first, second, third


_INDICES: weakref.WeakKeyDictionary[Field, BandIndex] = weakref.WeakKeyDictionary()
_MAKING = threading.Lock()
