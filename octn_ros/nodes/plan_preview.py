"""The picture of a plan that a person looks at before the laser fires: the raster over the view from above."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from octn_ros.nodes.conversions import GridView
from octn_ros.nodes.plan_pieces import GIVEN_UP_COLOUR, PlanPieces
from octn_ros.volume import VolumeGeometry

SIDE_PX = 800  # of the picture's longer side, about
FONT_PX, LINE_PX = 20, 26  # of the words below it: viewers show it at half its size
MARGIN_PX = 8
_NO_VIEW, _PAPER, _INK = 60, (24, 24, 28), (230, 230, 230)
_START_COLOUR = (255, 255, 255)


def draw_preview(
    pieces: PlanPieces, geometry: VolumeGeometry, view: GridView | None, words: Sequence[str]
) -> NDArray[np.uint8]:
    """Draw the raster in its colours over the en-face view, the start ringed in white, given-up points in red.

    Args:
        pieces: the plan in the OCT frame; its depth is not seen.
        geometry: of the scan.
        view: its view from above; None to draw over plain grey.
        words: sentences below the picture, each on a line of its own or on several.

    Returns:
        Pixels [rows, columns, (red, green, blue)]; x runs to the right and y down, as in the view.
    """
    if view is None:
        view = _empty_view(geometry)
    rows, columns = view.cells.shape
    scale = SIDE_PX / max(rows, columns)
    size = max(1, round(columns * scale)), max(1, round(rows * scale))
    grey = Image.fromarray(_stretched(view.cells)).resize(size, Image.Resampling.NEAREST)
    font = ImageFont.load_default(FONT_PX)
    columns_of_text = max(1, int((size[0] - 2 * MARGIN_PX) / font.getlength("0")))
    lines = [line for sentence in words for line in textwrap.wrap(sentence, columns_of_text)]
    picture = Image.new("RGB", (size[0], size[1] + LINE_PX * len(lines) + 2 * MARGIN_PX), _PAPER)
    picture.paste(grey.convert("RGB"), (0, 0))
    draw = ImageDraw.Draw(picture)

    def place(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points_m[..., :2] - view.corner_m) * (scale / view.cell_m))

    colours = np.rint(pieces.colours[:, :3] * 255).astype(int).tolist()
    for ends, colour in zip(place(pieces.pieces_m).reshape(-1, 4).tolist(), colours, strict=True):
        draw.line(ends, fill=tuple(colour), width=2)
    red = tuple(round(255 * part) for part in GIVEN_UP_COLOUR[:3])
    for x, y in place(pieces.given_up_m).tolist():
        draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill=red)
    if len(pieces.pieces_m):
        x, y = place(pieces.pieces_m[0, 0]).tolist()
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), outline=_START_COLOUR, width=2)
    for number, line in enumerate(lines):
        draw.text((MARGIN_PX, size[1] + MARGIN_PX + LINE_PX * number), line, fill=_INK, font=font)
    return np.asarray(picture)


def _empty_view(geometry: VolumeGeometry) -> GridView:
    """Return a view without grey levels over all voxels, half a voxel beyond the outermost centres."""
    along_m, _, across_m = geometry.spacing_m
    width_m, height_m = geometry.extent_m[0] + across_m, geometry.extent_m[1] + along_m
    cell_m = max(width_m, height_m) / SIDE_PX
    shape = max(1, round(height_m / cell_m)), max(1, round(width_m / cell_m))
    x, y, _ = geometry.origin_m
    return GridView(np.full(shape, -1, dtype=np.int8), (x - across_m / 2, y - along_m / 2), cell_m)


def _stretched(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return grey levels over the full range of those that are there, at 80 % so that colours stand out."""
    known = cells >= 0
    if not known.any():
        return np.full(cells.shape, _NO_VIEW, dtype=np.uint8)
    low, high = np.quantile(cells[known], (0.005, 0.995))
    share = np.clip((cells - low) / max(high - low, 1.0), 0.0, 1.0)
    return np.where(known, 204.0 * share, _NO_VIEW).astype(np.uint8)
