"""Pictures of a field by name: `bscan:128.5`, `enface:mip`, `plane:...`, as the command line and the graph say it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from octn_ros.errors import QueryError
from octn_ros.field import Field
from octn_ros.query.enface_views import enface, layer_mean
from octn_ros.query.rendering import RenderConfig, render
from octn_ros.query.slices import Plane, axial_slice, bscan_slice, lateral_slice, plane_slice
from octn_ros.query.surface import SurfaceMap, SurfaceMapConfig, surface_map

Quantity = Literal["intensity", "depth_m", "light"]
Vector = tuple[float, float, float]

# What a specification may say; lengths in millimetres.
FORMS = {
    "bscan": "bscan:POSITION",
    "axial": "axial:POSITION",
    "lateral": "lateral:POSITION",
    "enface": "enface:mip, enface:mean or enface:depth",
    "layer": "layer:FROM,TO (mm below the surface)",
    "plane": "plane:X,Y,Z;ALONG;DOWN;WIDTH,HEIGHT[;STEP] (mm; ALONG and DOWN are directions X,Y,Z)",
    "render": "render:AZIMUTH,ELEVATION (degrees)",
}
_ENFACE_MODES = ("mip", "mean", "depth")
_SURFACE_ASCANS = 16_384


@dataclass(frozen=True, eq=False)
class SliceImage:
    """A picture and where it lies; read-only.

    The centre of pixel (row, column) is `origin_m + row * down_m + column * along_m` in the OCT frame.

    Attributes:
        pixels: values [rows, columns], NaN where there are none.
        quantity: "intensity" (0 to 1), "depth_m" (metres from the OCT frame's origin along z) or "light" (a rendering).
        origin_m: place (x, y, z) of pixel (0, 0) in metres; along the beam and for renderings that of the view's plane.
        along_m: from one column to the next.
        down_m: from one row to the next.
        specification: what was asked for.
    """

    pixels: NDArray[np.float32]
    quantity: Quantity
    origin_m: Vector
    along_m: Vector
    down_m: Vector
    specification: str


@dataclass(frozen=True)
class SliceSpec:
    """A picture that can be asked for; see FORMS.

    Attributes:
        kind: a key of FORMS.
        mode: of an en-face view: mip, mean or depth; empty otherwise.
        numbers: as written, in the specification's own units.
    """

    kind: str
    mode: str = ""
    numbers: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> SliceSpec:
        """Read a specification; spaces do not count.

        Raises:
            QueryError: it has none of the FORMS.
        """
        kind, colon, rest = "".join(text.split()).partition(":")
        if not colon or kind not in FORMS:
            raise QueryError(f"expected a slice as {'; or '.join(FORMS.values())}; got {text!r}")
        if kind == "enface":
            if rest not in _ENFACE_MODES:
                raise QueryError(f"expected {FORMS[kind]}, got {text!r}")
            return cls(kind, rest)
        groups = [_numbers(group) for group in rest.split(";")]
        sizes = tuple(len(group) for group in groups)
        allowed = {"plane": ((3, 3, 3, 2), (3, 3, 3, 2, 1)), "render": ((2,),), "layer": ((2,),)}.get(kind, ((1,),))
        numbers = tuple(number for group in groups for number in group)
        if sizes not in allowed or not all(math.isfinite(number) for number in numbers):
            raise QueryError(f"expected {FORMS[kind]}, got {text!r}")
        return cls(kind, "", numbers)

    def evaluate(self, field: Field, *, progress: Callable[[float], None] | None = None) -> SliceImage:
        """Take the picture.

        Args:
            field: the field to look at.
            progress: called with the share that is done, 0 to 1, by pictures that take long.

        Raises:
            QueryError: what is asked for lies outside the scan, or the field has no surface.
            ConfigurationError: an angle of a rendering is out of range.
        """
        if self.kind in ("bscan", "axial", "lateral"):
            return self._cut(field)
        if self.kind == "plane":
            plane = self.plane(min(field.geometry.spacing_m))
            along, down = (np.array(direction) * plane.step_m for direction in (plane.along, plane.down))
            return self._image(plane_slice(field, plane), "intensity", plane.origin_m, along, down)
        if self.kind == "render":
            azimuth, elevation = self.numbers
            picture = render(field, RenderConfig(azimuth, elevation), progress=progress)
            right, down = picture.right * picture.step_m, picture.down * picture.step_m
            return self._image(picture.grey, "light", picture.origin_m, right, down)
        return self._seen_from_above(field, progress)

    def plane(self, default_step_m: float) -> Plane:
        """Return the plane of a specification `plane:...`, with a step of its own or the default one.

        Raises:
            QueryError: it is none; see `Plane`.
        """
        x, y, z, ax, ay, az, dx, dy, dz, width, height, *step = self.numbers
        return Plane(
            (x * 1e-3, y * 1e-3, z * 1e-3),
            (ax, ay, az),
            (dx, dy, dz),
            (width * 1e-3, height * 1e-3),
            step[0] * 1e-3 if step else default_step_m,
        )

    def _cut(self, field: Field) -> SliceImage:
        (bscan, axial, lateral), (x, y, z) = field.geometry.spacing_m, field.geometry.origin_m
        (position,) = self.numbers
        if self.kind == "bscan":
            pixels, origin = bscan_slice(field, position), (x, y + position * bscan, z)
            return self._image(pixels, "intensity", origin, (lateral, 0.0, 0.0), (0.0, 0.0, axial))
        if self.kind == "axial":
            pixels, origin = axial_slice(field, position), (x, y, z + position * axial)
            return self._image(pixels, "intensity", origin, (lateral, 0.0, 0.0), (0.0, bscan, 0.0))
        pixels, origin = lateral_slice(field, position), (x + position * lateral, y, z)
        return self._image(pixels, "intensity", origin, (0.0, bscan, 0.0), (0.0, 0.0, axial))

    def _seen_from_above(self, field: Field, progress: Callable[[float], None] | None) -> SliceImage:
        geometry = field.geometry
        if self.mode in ("mip", "mean"):
            pixels = enface(field, "mip" if self.mode == "mip" else "mean", progress=progress)
            steps = (geometry.spacing_m[2], 0.0, 0.0), (0.0, geometry.spacing_m[0], 0.0)
            return self._image(pixels, "intensity", geometry.origin_m, *steps)
        surface = surface_map(field, SurfaceMapConfig(max_ascans=_SURFACE_ASCANS))
        origin, along, down = _lattice_of(surface, geometry.origin_m[2])
        if self.mode == "depth":
            return self._image(surface.depth_m.astype(np.float32), "depth_m", origin, along, down)
        top, bottom = self.numbers
        pixels = layer_mean(field, surface, top * 1e-3, bottom * 1e-3)
        return self._image(pixels, "intensity", origin, along, down)

    def _image(
        self,
        pixels: NDArray[np.float32],
        quantity: Quantity,
        origin: Vector | NDArray[np.float64],
        along: Vector | NDArray[np.float64],
        down: Vector | NDArray[np.float64],
    ) -> SliceImage:
        return SliceImage(pixels, quantity, _vector(origin), _vector(along), _vector(down), str(self))

    def __str__(self) -> str:
        numbers = [f"{number:.12g}" for number in self.numbers]
        if self.kind == "plane":
            groups = [numbers[0:3], numbers[3:6], numbers[6:9], numbers[9:11], numbers[11:]]
            return "plane:" + ";".join(",".join(group) for group in groups if group)
        return f"{self.kind}:{self.mode or ','.join(numbers)}"


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return (math.nan,)  # refused as any other number that is none, with the form that is expected


def _lattice_of(surface: SurfaceMap, z_m: float) -> tuple[Vector, Vector, Vector]:
    x, y = surface.lateral_m, surface.bscan_m
    return (float(x[0]), float(y[0]), z_m), (float(x[1] - x[0]), 0.0, 0.0), (0.0, float(y[1] - y[0]), 0.0)


def _vector(values: Vector | NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
