"""The demo from end to end: a run over the graph, its figures, and its report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from octn_ros.demo import pictures
from octn_ros.demo.assessment import Assessment, assess, render_bscans
from octn_ros.demo.graph import DemoError
from octn_ros.demo.pictures import PathPicture
from octn_ros.demo.report import ReportPicture, render_report
from octn_ros.demo.result import DemoResult
from octn_ros.demo.session import LINE_SPACING_M, ONE_PROCESS, TIME_FACTOR, SessionRecord, Show, Stopwatch, run_session
from octn_ros.demo.source import ScanSource
from octn_ros.demo.versions import software_versions
from octn_ros.query import SurfaceMapConfig, enface, surface_map

REPORT_NAME = "report.html"
SURFACE_ASCANS = 4096  # of the 3D picture


def run_demo(
    source: ScanSource,
    fit_parameters: Mapping[str, Any],
    output: Path,
    show: Show,
    seconds: Mapping[str, float],
    record: Path | None = None,
) -> DemoResult:
    """Run the graph on a source, work out the figures, write the report.

    Args:
        source: what is scanned.
        fit_parameters: parameters of the trainer, `fit.time_budget_s` among them.
        output: directory for the report; it exists. A report that lies there is removed first.
        show: told what is going on.
        seconds: durations of what was done before.
        record: a file for a recording of the graph, None for none.

    Raises:
        OctnError: a node refused, failed or did not answer in time, a parameter is not allowed, or the report cannot be
            written.
    """
    path = output / REPORT_NAME
    try:
        path.unlink(missing_ok=True)  # after a run that fails, that of a run before would be taken for its report
    except OSError as error:
        raise DemoError(f"{path}: cannot be replaced: {error.strerror or error}") from error
    session = run_session(source, fit_parameters, show, record)
    watch = Stopwatch({**seconds, **session.seconds})
    with watch.part("evaluate"):
        show("evaluating", 0.0, "")
        assessment = assess(source, session)
    with watch.part("draw"):
        show("drawing", 0.0, "")
        drawn = _pictures(source, session, assessment)
    result = _result(source, session, assessment, str(path), watch.seconds)
    page = render_report(
        "octn demo: from a C-scan to an executed laser path",
        result.rows(),
        drawn,
        _configuration(source, session, fit_parameters),
        software_versions(),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise DemoError(f"{path}: cannot write the report: {error.strerror or error}") from error
    return result


def _result(
    source: ScanSource, record: SessionRecord, assessment: Assessment, report: str, seconds: dict[str, float]
) -> DemoResult:
    distance = assessment.distance
    return DemoResult(
        source=source.name,
        fit_s=float(record.fit["seconds"]),
        steps=int(record.fit["steps"]),
        psnr_db=assessment.psnr_db,
        psnr_truth_db=assessment.psnr_truth_db,
        gaussian_psnr_truth_db=assessment.gaussian_psnr_truth_db,
        psnr_bscans=len(assessment.bscans),
        bscans=source.volume.geometry.shape[0],
        requested=int(record.plan["requested"]),
        waypoints=len(record.waypoints_oct),
        given_up=int(record.plan["given_up"]),
        hit_rate=float(record.plan["hit_rate"]),
        tau=float(record.plan["tau"]),
        smoothness_mm2=float(record.plan["smoothness_mm2"]),
        rms_error_um=distance.rms_um if distance else None,
        offset_um=distance.offset_um if distance else None,
        spread_um=distance.spread_um if distance else None,
        max_error_um=distance.max_um if distance else None,
        method=record.plan["method"],
        executed=int(record.execution["shots"]),
        arm_time_factor=TIME_FACTOR,
        field_hash=record.field_hash,
        report=report,
        seconds=seconds,
    )


def _pictures(source: ScanSource, record: SessionRecord, assessment: Assessment) -> list[ReportPicture]:
    volume = source.volume
    geometry, field = volume.geometry, record.field
    points = record.waypoints_oct[:, :3, 3]
    path = PathPicture(points * 1e3, record.tool_path["segment"].astype(np.int32))
    index = _bscan_under_path(source, points)
    shown = np.array([index])
    measured = volume.normalized()[index]
    surface = surface_map(field, SurfaceMapConfig(max_ascans=SURFACE_ASCANS))
    drawn = [
        ReportPicture(
            "View from above",
            "The largest intensity of each A-scan of the measured volume, grey levels stretched, and over it the "
            "planned raster, coloured by the depth at which the surface was found.",
            pictures.enface_picture(enface(volume), geometry, path),
        ),
        ReportPicture(
            "A B-scan, measured and from the field",
            "To scale; depth is the optical path from the first axial voxel. The waypoints are those whose raster line "
            "lies within half a B-scan of this one. The difference is speckle that the field leaves out and, at edges, "
            "what it blurs.",
            pictures.bscan_picture(
                measured, render_bscans(field, shown)[0], geometry, index, path, _true_surface_mm(source, index)
            ),
        ),
        ReportPicture(
            "The fit",
            "PSNR against native voxels drawn at random, and the loss, as the trainer published them on fit_progress. "
            "In the hybrid stage a share alpha of the samples is interpolated between voxels, in the discrete stage "
            "none is (Algorithm 1).",
            pictures.fit_picture(record.history),
        ),
        ReportPicture(
            "The surface and the path",
            "The surface of the fitted field by its largest axial rise (eq. 3), to scale, with the laser path over it. "
            "It is left out where it lies far above or below the path.",
            pictures.surface_picture(surface.depth_m * 1e3, surface.lateral_m * 1e3, surface.bscan_m * 1e3, path),
        ),
    ]
    if assessment.depth_error_um is not None:
        drawn.append(
            ReportPicture(
                "How far the waypoints lie from the truth",
                "Depth of each waypoint minus the depth of the phantom's true surface there; positive is deeper.",
                pictures.error_picture(path.points_mm, assessment.depth_error_um),
            )
        )
    return drawn


def _bscan_under_path(source: ScanSource, points_m: NDArray[np.float64]) -> int:
    """Return the B-scan nearest to the raster line in the middle of the path."""
    y = points_m[:, 1]
    middle = y[np.argmin(np.abs(y - np.median(y)))]
    return int(np.rint((middle - source.volume.geometry.origin_m[1]) / source.volume.geometry.spacing_m[0]))


def _true_surface_mm(source: ScanSource, index: int) -> NDArray[np.float64] | None:
    if source.surface_depth_m is None:
        return None
    (_, _, laterals), (d, _, w) = source.volume.geometry.shape, source.volume.geometry.spacing_m
    x, y, _ = source.volume.geometry.origin_m
    lateral = np.asarray(x + np.arange(laterals) * w, dtype=np.float64)
    return source.surface_depth_m(lateral, np.full(laterals, y + index * d)) * 1e3


def _configuration(
    source: ScanSource, record: SessionRecord, fit_parameters: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    training = dict(record.field.description.training)
    return {
        "scanned": source.description,
        "fit, as stored in the field": training,
        "trainer parameters given": dict(fit_parameters),
        "planner": {
            "config": json.loads(record.plan["config"]),
            "line_spacing_m": LINE_SPACING_M,
            "method": record.plan["method"],
            "field_hash": record.field_hash,
            "calibration": "config/calibration.yaml of the package",
        },
        "arm": dict(ONE_PROCESS),
    }
