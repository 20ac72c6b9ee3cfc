"""A three-dimensional picture of a field: orthographic volume rendering, front to back.

The transfer function: intensity I becomes opacity per millimetre of path, 0 up to `clear_below`, rising as a smooth
step to `opacity_per_mm` at `solid_above`. The colour of a point is its grey level, I stretched over the same range
and dimmed where the tissue turns away from the viewer (a lamp at the camera: `ambient` + (1 - `ambient`) |cos|).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from octn_ros.errors import ConfigurationError
from octn_ros.field import Field
from octn_ros.query.lattice import Lattice
from octn_ros.query.regions import Region
from octn_ros.settings import check_settings, setting

# A ray through which less light than this comes is done.
_DARK = 1e-3
_RAMP_FLOOR = 0.25  # grey level of tissue that is only just opaque


@dataclass(frozen=True)
class RenderConfig:
    """Where the camera stands and how intensity becomes light."""

    azimuth_deg: float = setting(
        30.0, "turn of the camera about the beam, from the side of the last B-scan towards the first column", unit="deg"
    )
    elevation_deg: float = setting(
        35.0, "height of the camera above the scan, 90 looks along the beam", unit="deg", low=-90.0, high=90.0
    )
    pixels: int = setting(320, "width and height of the picture", unit="px", low=16, high=4096)
    lattice_points: int = setting(
        1_000_000, "points at which the field is evaluated, evenly spaced", low=1000, high=100_000_000
    )
    clear_below: float = setting(0.0, "intensity without opacity; 0 to tell air from tissue (Otsu)", low=0.0, high=1.0)
    solid_above: float = setting(
        0.0, "intensity of full opacity; 0 for the brightest hundredth of the scan", low=0.0, high=1.0
    )
    opacity_per_mm: float = setting(12.0, "largest opacity", unit="1/mm", low=0.01, high=10_000.0)
    ambient: float = setting(0.45, "share of light that does not depend on the tissue's slope", low=0.0, high=1.0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.clear_below and self.solid_above and not self.clear_below < self.solid_above:
            raise ConfigurationError(
                f"RenderConfig: expected clear_below < solid_above, got {self.clear_below} and {self.solid_above}"
            )

    def camera_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the unit vectors (right, down, forward) of the picture in the OCT frame.

        Azimuth 0, elevation 0 looks along -y, where x runs to the right and z down as in a B-scan; elevation 90 looks
        along the beam, where x runs to the right and y down as in an en-face view. Azimuth turns about z, from x to y.
        """
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        turn = np.array([[math.cos(a), -math.sin(a), 0.0], [math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])
        right = turn @ np.array([1.0, 0.0, 0.0])
        down = turn @ np.array([0.0, math.sin(e), math.cos(e)])
        return right, down, np.cross(right, down)


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture of a field; read-only.

    Attributes:
        grey: light [rows, columns], 0 (nothing in the way) to 1.
        opacity: share of the background that is covered [rows, columns], 0 to 1.
        origin_m: centre (x, y, z) of pixel (0, 0) in the plane through the middle of the scan, in the OCT frame.
        right: unit vector along which columns follow each other.
        down: unit vector along which rows follow each other.
        step_m: size of a pixel.
    """

    grey: NDArray[np.float32]
    opacity: NDArray[np.float32]
    origin_m: NDArray[np.float64]
    right: NDArray[np.float64]
    down: NDArray[np.float64]
    step_m: float


def render(
    field: Field,
    config: RenderConfig | None = None,
    region: Region | None = None,
    *,
    progress: Callable[[float], None] | None = None,
) -> Rendering:
    """Render a field as a translucent body, seen from far away (orthographic), without perspective.

    The field is evaluated once on an even lattice; rays are then composited front to back through it, with trilinear
    interpolation. The same field and configuration give the same picture on the same machine. Thread-safe; any device.

    Args:
        field: the field to look at.
        config: camera and transfer function; the defaults if left out.
        region: only the box around it is drawn; None for the whole scan.
        progress: called with the share that is done, 0 to 1; what it raises ends the query.

    Raises:
        QueryError: the region does not touch the scan.
    """
    config = config or RenderConfig()
    # Positions along (lateral, bscan, axial) = (x, y, z) from here on.
    low, high, values = _evaluate(field, config, region, progress)
    centre, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    right, down, forward = config.camera_axes()
    spacing = (high - low) / (np.array(values.shape)[[2, 0, 1]] - 1)
    density, light = _transfer(values, spacing, forward, config)
    volume = torch.stack([density, density * light])[None].to(field.device)

    half = _half_size(high - low, right, down)
    step = 2.0 * half / (config.pixels - 1)
    offsets = np.linspace(-half, half, config.pixels)
    # In units of half the box, whose faces then lie at -1 and 1.
    scale = 2.0 / (high - low)
    start = (offsets[:, None, None] * down + offsets[None, :, None] * right).reshape(-1, 3) * scale
    marches = max(2, math.ceil(diagonal / float(spacing.min())))
    rays = _Rays(volume, start, forward * scale, diagonal / marches)
    for march in range(marches):
        if not rays.advance(-diagonal / 2 + (march + 0.5) * diagonal / marches):
            break
        if progress:
            progress(0.5 + 0.5 * (march + 1) / marches)
    if progress:
        progress(1.0)
    square = config.pixels, config.pixels
    grey, opacity = rays.light.clamp(0.0, 1.0), 1.0 - rays.through
    return Rendering(
        grey.reshape(square).cpu().numpy(),
        opacity.reshape(square).cpu().numpy(),
        centre - half * (right + down),
        right,
        down,
        step,
    )


class _Rays:
    """Light along parallel rays, gathered front to back; only rays inside the box that are not yet dark are sampled.

    Args:
        volume: opacity per millimetre, and that times the light of the point, [1, 2, bscan, axial, lateral].
        start: where the rays cross the plane through the middle of the box [N, 3], in (x, y, z) of half the box.
        forward: the way along a ray per metre, likewise.
        step_m: metres between samples.
    """

    def __init__(self, volume: Tensor, start: NDArray[np.float64], forward: NDArray[np.float64], step_m: float) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            faces = (np.array([-1.0, 1.0])[:, None, None] - start) / forward
        # A ray along a face is inside between -inf and inf, or never.
        beside = np.abs(forward) < 1e-9
        faces[0][:, beside], faces[1][:, beside] = -np.inf, np.where(np.abs(start[:, beside]) <= 1.0, np.inf, -np.inf)
        enter, leave = faces.min(axis=0).max(axis=1), faces.max(axis=0).min(axis=1)
        self._volume, self._step_m = volume, step_m
        # grid_sample wants (lateral, axial, bscan) for an array [bscan, axial, lateral].
        self._start, self._forward = (
            torch.from_numpy(a[..., [0, 2, 1]].astype(np.float32)).to(volume.device) for a in (start, forward)
        )
        self._enter, self._leave = (torch.from_numpy(a).to(volume.device) for a in (enter, leave))
        self.light = torch.zeros(len(start), device=volume.device)
        self.through = torch.ones_like(self.light)

    def advance(self, depth_m: float) -> bool:
        """Take the samples at one depth along the rays; return whether any ray can still change."""
        bright = (self.through > _DARK) & (self._leave >= depth_m)
        inside = torch.nonzero(bright & (self._enter <= depth_m))[:, 0]
        if len(inside):
            here = self._start[inside] + self._forward * depth_m
            # Samples just outside, between the last lattice plane and the face, count as on it.
            density, glow = torch.nn.functional.grid_sample(
                self._volume, here[None, None, None], padding_mode="border", align_corners=True
            )[0, :, 0, 0]
            # The share of light that a step takes, with the opacity of each point as a density along the path.
            taken = 1.0 - torch.exp(-density * (self._step_m * 1e3))
            through = self.through[inside]
            self.light[inside] += through * taken * glow / density.clamp(min=1e-12)
            self.through[inside] = through * (1.0 - taken)
        return bool(bright.any())


def _evaluate(
    field: Field, config: RenderConfig, region: Region | None, progress: Callable[[float], None] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], Tensor]:
    """Return the corners (x, y, z) of the box that is drawn and the intensities [bscan, axial, lateral] over it."""
    whole = Lattice.over(field.geometry, region, name="render")
    box = [axis[[0, -1]] for axis in whole.axes_m()]
    sides = [float(np.ptp(side)) for side in box]
    longest = max(sides)
    # A flat box has a side of 0: it is given the thickness of one step so that the volume below stays finite.
    step = (math.prod(max(side, 1e-3 * longest) for side in sides) / config.lattice_points) ** (1 / 3)
    spacing, counts = field.geometry.spacing_m, []
    for side, native in zip(sides, (spacing[2], spacing[0], spacing[1]), strict=True):
        counts.append(max(2, math.ceil(side / max(step, native / 2)) + 1))
    lateral, bscan, axial = (np.linspace(a[0], a[-1], n) for a, n in zip(
        (whole.lateral, whole.bscan, whole.axial), counts, strict=True))  # fmt: skip
    lattice = Lattice(field.geometry, bscan, axial, lateral, native=False)
    values = np.empty(lattice.shape, dtype=np.float32)
    for planes in lattice.slabs(1 << 19):
        values[planes] = lattice.evaluate(field, planes)
        if progress:
            progress(0.5 * planes.stop / len(bscan))
    low, high = np.array([side[0] for side in box]), np.array([side[-1] for side in box])
    high = np.maximum(high, low + 1e-3 * longest)
    return low, high, torch.from_numpy(values)


def _transfer(
    values: Tensor, spacing: NDArray[np.float64], forward: NDArray[np.float64], config: RenderConfig
) -> tuple[Tensor, Tensor]:
    """Return opacity per millimetre and light of each lattice point [bscan, axial, lateral]."""
    from skimage.filters import threshold_otsu

    array = values.numpy()
    clear = config.clear_below or float(threshold_otsu(array))
    solid = config.solid_above or float(np.quantile(array, 0.99))
    solid = max(solid, clear + 1e-3)
    ramp = ((values - clear) / (solid - clear)).clamp(0.0, 1.0)
    density = config.opacity_per_mm * ramp * ramp * (3.0 - 2.0 * ramp)
    # Gradients per metre, so that the shading is of the body in space and not of its voxels.
    slopes = [np.gradient(array, s, axis=axis) for s, axis in zip(spacing, (2, 0, 1), strict=True)]
    length = np.sqrt(sum(slope**2 for slope in slopes)) + 1e-12
    facing = np.abs(sum(f * slope for f, slope in zip(forward, slopes, strict=True))) / length
    shade = config.ambient + (1.0 - config.ambient) * facing
    grey = _RAMP_FLOOR + (1.0 - _RAMP_FLOOR) * ramp
    return density, grey * torch.from_numpy(shade.astype(np.float32))


def _half_size(sides: NDArray[np.float64], right: NDArray[np.float64], down: NDArray[np.float64]) -> float:
    """Return half the side of the square that holds the box as the camera sees it, with a margin of a fiftieth."""
    return float(max(np.abs(axis) @ sides for axis in (right, down)) / 2 * 1.02)
