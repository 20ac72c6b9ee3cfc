"""How the kernels are compiled, and the sizes they share."""

from __future__ import annotations

from typing import Any

# Lattice points are walked in bricks of this many along each axis, of which a layer lies in one plane of B-scans. The
# network runs on tiles of points, two layers at a time where there are two: wide enough that a loop's setting up does
# not count, small enough for a layer of the network to stay in the nearest cache.
BRICK = 8
LAYER = BRICK * BRICK
TILE = 2 * LAYER

# Compiled code is cached beside the package, or in the user's cache where that cannot be written. The cache notices a
# change of a kernel's own file, not of one that it calls or of these options: after editing kernels, delete the *.nbi
# and *.nbc files. Reassociation and contraction are what lets loops use vector registers; results differ from the
# reference by rounding only. NaN and infinity keep their meaning, since a diverged fit is told by them. The kernels
# release the interpreter lock, so that plain threads run them side by side.
KERNEL: dict[str, Any] = {
    "nogil": True,
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "cache": True,
    "error_model": "numpy",
}
