"""PSNR against seconds, and at equal samples, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from octn_ros.demo import canvas
from octn_ros.evaluation.speed_curves import Curve

_COLOURS = {"eager": "#8a9099", "compile": "#c8641b", "fused": "#1f5fa8"}
_LINES = {"data": "-", "mean": "--"}


def curves_picture(
    panels: Mapping[str, tuple[Sequence[Curve], float]], target_db: float, limit_s: float = 10.0
) -> bytes:
    """Draw PSNR against the truth and the measured voxels over the seconds of each fit.

    Args:
        panels: curves by phantom, with the PSNR of a Gaussian of one voxel against the truth.
        target_db: the PSNR against the measured voxels that is asked for.
        limit_s: the time in which it is asked for.
    """
    with canvas.figure(canvas.WIDTH_IN, 3.2 * len(panels)) as figure:
        axes = figure.subplots(len(panels), 2, squeeze=False)
        for row, (title, (curves, gaussian_db)) in zip(axes, panels.items(), strict=True):
            for axis, quantity, line_db, line in (
                (row[0], "truth_db", gaussian_db, "Gaussian of one voxel"),
                (row[1], "noisy_db", target_db, f"{target_db:g} dB"),
            ):
                for curve in curves:
                    seconds = [point.seconds for point in curve.points]
                    values = [getattr(point, quantity) for point in curve.points]
                    axis.plot(seconds, values, _LINES[curve.start], color=_COLOURS[curve.way], marker=".", markersize=4,
                              linewidth=1.1, label=f"{curve.way}, from the {curve.start}")  # fmt: skip
                axis.axhline(line_db, color=canvas.INK, linewidth=0.8, linestyle=":", label=line)
                axis.axvline(limit_s, color="#c9cdd2", linewidth=0.8)
                axis.set(xscale="log", xlabel="seconds from the array, compiling left out")
            row[0].set(ylabel="PSNR against the truth (dB)", title=title)
            row[1].set(ylabel="PSNR against the voxels (dB)")
        axes[0][0].legend(fontsize=7)
        return canvas.png(figure)


def samples_picture(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw PSNR against the truth and the measured voxels over the samples, bricks beside lone ones."""
    with canvas.figure(canvas.WIDTH_IN, 3.2) as figure:
        for axis, key, what in zip(
            figure.subplots(1, 2), ("psnr_truth_db", "psnr_noisy_db"), ("truth", "voxels"), strict=True
        ):
            for sampling, colour in (("lone", canvas.ORANGE), ("bricks", canvas.BLUE)):
                for start, line in _LINES.items():
                    chosen = [row for row in rows if row["way"] == sampling and row["start"] == start]
                    axis.plot([row["samples"] / 1e6 for row in chosen], [row[key] for row in chosen], line,
                              color=colour, marker=".", label=f"{sampling}, from the {start}")  # fmt: skip
            axis.set(xscale="log", xlabel="samples (millions)", ylabel=f"PSNR against the {what} (dB)")
            axis.legend(fontsize=7)
        return canvas.png(figure)
