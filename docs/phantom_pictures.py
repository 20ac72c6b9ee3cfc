"""Draw the pictures of docs/phantoms.md again: `python docs/phantom_pictures.py`."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageColor

from octn_ros.demo import canvas
from octn_ros.simulation import make_phantom, named_phantom

IMAGES = Path(__file__).parent / "images"
SYSTEM = "-13dB-single-look"
PICTURES = {
    "phantoms_smooth": [f"{name}{SYSTEM}" for name in ("flat", "tilted15", "tilted30", "wavy", "rough", "steep45")],
    "phantoms_adverse": [
        f"{name}{SYSTEM}" for name in ("stepped", "glare", "shadow", "detached-layer", "dye", "motion")
    ],
    "phantoms_systems": [
        "wavy-8dB-single-look",
        "wavy-13dB-single-look",
        "wavy-18dB-single-look",
        "wavy-13dB-single-look-grain1.2",
        "wavy-15dB-averaged",
        "wavy-13dB-single-look-top-layer",
    ],
}
AXIAL_ROWS = 130
GREYS = 28
SURFACE, MASK = "#e8541e", "#2aa9d2"


def draw(names: list[str]) -> bytes:
    """Return six B-scans as one PNG: where most of the surface is hidden, with the surface and the mask drawn in."""
    with canvas.figure(8.0, 4.1) as drawn:
        for axes, name in zip(drawn.subplots(2, 3).ravel(), names, strict=True):
            config = named_phantom(name)
            phantom = make_phantom(config)
            (bscans, _, laterals), (d, h, w) = config.shape, config.spacing_m
            x, y = np.meshgrid(np.arange(laterals) * w, np.arange(bscans) * d)
            mask = phantom.artefact_mask(x, y)
            along_bscan = "motion" in name
            at = laterals // 2 if along_bscan else int(np.argmax(mask.sum(axis=1))) if mask.any() else bscans // 2
            image = phantom.volume.array[:, :, at].T if along_bscan else phantom.volume.array[at]
            place = (y[:, at] if along_bscan else x[at]) * 1e3
            depth = (phantom.surface_depth_m(x, y)[:, at] if along_bscan else phantom.surface_depth_m(x, y)[at]) * 1e3
            hidden = mask[:, at] if along_bscan else mask[at]
            first = max(0, int(depth.min() / (h * 1e3)) - 40)
            rows = max(AXIAL_ROWS, int(np.ptp(depth) / (h * 1e3)) + 60)
            shown = image[first : first + rows]
            edges = (0, place[-1], (first + len(shown)) * h * 1e3, first * h * 1e3)
            axes.imshow(shown, cmap="gray", vmin=0, vmax=255, extent=edges, aspect="auto", interpolation="nearest")
            axes.plot(place, depth, color=SURFACE, linewidth=1.0)
            if hidden.any():
                axes.fill_between(place, 0, 0.025, where=hidden, color=MASK, transform=axes.get_xaxis_transform())
            axes.set_title(name, fontsize=8)
            axes.tick_params(labelsize=6)
        drawn.supxlabel("bscan (motion) or lateral (all others), mm", fontsize=7)
        drawn.supylabel("depth, mm", fontsize=7)
        return canvas.png(drawn)


def main() -> None:
    """Write every picture, in few greys so that speckle stays small on disk."""
    greys = [level for grey in np.linspace(0, 255, GREYS).astype(int) for level in (grey, grey, grey)]
    colours = [level for colour in (SURFACE, MASK) for level in ImageColor.getrgb(colour)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(greys + colours)
    for file_name, names in PICTURES.items():
        picture = Image.open(io.BytesIO(draw(names))).convert("RGB").resize((880, 451), Image.Resampling.BOX)
        picture.quantize(palette=palette, dither=Image.Dither.NONE).save(IMAGES / f"{file_name}.png", optimize=True)


if __name__ == "__main__":
    main()
