"""The closed loop from end to end: the run, its figures, and its report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from octn_ros.demo import closed_loop_pictures
from octn_ros.demo.ablation_request import AblationRequest
from octn_ros.demo.closed_loop import ClosedLoopRecord, run_closed_loop
from octn_ros.demo.closed_loop_result import ClosedLoopResult, ascan_places, closed_loop_result
from octn_ros.demo.graph import DemoError
from octn_ros.demo.report import ReportPicture, render_report
from octn_ros.demo.session import ONE_PROCESS, Show, Stopwatch
from octn_ros.demo.source import phantom_source
from octn_ros.demo.versions import software_versions
from octn_ros.simulation import PhantomConfig

REPORT_NAME, AUDIT_NAME = "closed_loop.html", "audit.jsonl"
# What the loop is not told: the platform's errors, and a tissue that takes a fifth more energy than it is taken for.
PLATFORM: Mapping[str, Any] = {
    **ONE_PROCESS,
    "laser.heat_of_ablation_j_per_m3": 4.2e9,
    "inaccuracy.calibration_error_m": 20e-6,
    "inaccuracy.calibration_error_deg": 0.1,
    "inaccuracy.pose_noise_m": 5e-6,
}


def closed_loop_demo(
    config: PhantomConfig,
    request: AblationRequest,
    fit_parameters: Mapping[str, Any],
    output: Path,
    show: Show,
    recording: Path | None = None,
) -> ClosedLoopResult:
    """Ablate a phantom in a closed loop, work out the figures, write the report and the audit record.

    Args:
        config: the phantom.
        request: where and how deep.
        fit_parameters: parameters of the trainer, `fit.time_budget_s` among them.
        output: directory for the report and the record; it exists. Those that lie there are removed first.
        show: told what is going on.
        recording: a file for a recording of the graph, None for none.

    Raises:
        OctnError: a node refused, failed or did not answer in time, or a file cannot be written.
    """
    watch, audit, path = Stopwatch(), output / AUDIT_NAME, output / REPORT_NAME
    with watch.part("load"):
        show("loading", 0.0, "")
        source = phantom_source(config)
    try:
        for old in (audit, path):
            old.unlink(missing_ok=True)
        record = run_closed_loop(source, request, fit_parameters, PLATFORM, audit, show, recording)
        show("drawing", 0.0, "")
        seconds = {**watch.seconds, **record.seconds}
        geometry = source.volume.geometry
        result = closed_loop_result(source.name, geometry, request, record, audit, path, seconds)
        configuration = {
            "phantom": source.description,
            "request": dataclasses.asdict(request),
            "platform, unknown to the loop": dict(PLATFORM),
            "trainer parameters given": dict(fit_parameters),
        }
        title = "octn demo --closed-loop: ablation to a depth, pass by pass"
        pictures = _pictures(config, request, record, result)
        page = render_report(title, result.rows(), pictures, configuration, software_versions())
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise DemoError(f"{error.filename or path}: cannot write: {error.strerror or error}") from error
    return result


def _pictures(
    config: PhantomConfig, request: AblationRequest, record: ClosedLoopRecord, result: ClosedLoopResult
) -> list[ReportPicture]:
    geometry = config.geometry
    x, y = ascan_places(geometry)
    removed = [np.zeros((len(y), len(x))), *record.removed_m]
    middle_m = 0.5 * (request.corners_m[0][1] + request.corners_m[1][1])
    row, true_row = (int(np.argmin(np.abs(places - middle_m))) for places in (record.surfaces[0].bscan_m, y))
    whole = config.true_surface().depth_at(x, np.full(len(x), y[true_row]))
    return [
        ReportPicture(
            "What is gone",
            "The simulator's own map of the depth taken away, and how far that is from the request. Solid: the "
            "rectangle; dashed: less the band of one spot radius that the figures leave out.",
            closed_loop_pictures.depth_map_picture(removed[-1], request, geometry),
        ),
        ReportPicture(
            "Pass by pass",
            "Each pass is planned on a field fitted to a new scan, and its bursts are as long as the depth that the "
            "passes before took says.",
            closed_loop_pictures.passes_picture(result.passes, result.requested_um),
        ),
        ReportPicture(
            "The surface along one B-scan",
            "Coloured: the surface of the field fitted to each scan by its largest axial rise (eq. 3); thin: the true "
            "one. A constant offset between them does not matter to the depth gone. On the walls, which are steeper "
            "than the scan resolves, they part.",
            closed_loop_pictures.profile_picture(
                [surface.depth_m[row] for surface in record.surfaces],
                [whole + gone[true_row] for gone in removed],
                record.surfaces[0].lateral_m,
                x,
            ),
        ),
    ]
