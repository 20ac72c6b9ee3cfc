"""Files that hold several arrays by name: which of them is the C-scan."""

from __future__ import annotations

from octn_ros.errors import VolumeError

VOLUME_KEY = "volume"


def choose_array(shapes: dict[str, tuple[int, ...]], variable: str | None) -> str:
    """Return the name of the array to read: the one asked for, else `volume`, else the only one of three axes.

    Args:
        shapes: the numeric arrays in the file.
        variable: the name asked for, None if none was.

    Raises:
        VolumeError: there is no such array, or several that could be meant.
    """
    listed = ", ".join(f"{name[:40]} {shape}" for name, shape in list(shapes.items())[:20]) or "no array of numbers"
    candidates = [name for name, shape in shapes.items() if len(shape) == 3]
    if variable is not None:
        if variable not in candidates:
            raise VolumeError(f"expected an array {variable!r} of three axes, the file holds {listed}")
        return variable
    if VOLUME_KEY in candidates:
        return VOLUME_KEY
    if len(candidates) != 1:
        raise VolumeError(
            f"expected one array of three axes, the file holds {listed}; name one with --variable, in Python variable"
        )
    return candidates[0]
