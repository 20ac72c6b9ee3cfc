"""Fits of C-scans in a thread of their own, with what they have to say for themselves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch

from octn_ros.errors import CheckpointError
from octn_ros.field import NeuralField, dumps_field, field_hash
from octn_ros.nodes import status
from octn_ros.nodes.field_store import KeptField
from octn_ros.nodes.freed_memory import give_back_freed_memory
from octn_ros.nodes.present_scan import NewScan, PresentScan
from octn_ros.nodes.worker import Worker
from octn_ros.training import FitConfig, FitProgress, FitResult, fit
from octn_ros.training.half_precision import half_precision_loss

FITTED = ("steps", "seconds", "ended", "psnr_db", "float16_rms", "float16_largest")  # figures of a finished fit
EXIT_WAIT_S = 0.5  # a cancelled fit ends after its present step; longer than that nobody waits for it


class FieldFitter:
    """Fits one C-scan at a time and publishes the field if the scan is still the present one.

    Methods may be called from any thread. Publishing from the worker's thread is safe, as publishers are.

    Args:
        device: where the model is trained.
        present: what the graph knows.
        progress: where a fit says how it goes.
        failed: called with the reason of a failure.
        running: asked whether the graph still exists.
    """

    def __init__(
        self,
        device: torch.device,
        present: PresentScan,
        progress: status.StatusTopic,
        failed: Callable[[str], None],
        running: Callable[[], bool],
    ) -> None:
        self._device, self._present, self._progress = device, present, progress
        self._failed, self._running = failed, running
        self._worker = Worker("fit")
        self._fitted: NeuralField | None = None
        self.figures: dict[str, Any] = {}

    @property
    def busy(self) -> bool:
        """Whether a fit runs or waits."""
        return self._worker.busy

    def start_from(self, field: NeuralField, kept: KeptField) -> dict[str, Any]:
        """Let the next warm start begin with a field that was kept; return what is known of its fit."""
        self._fitted = field
        training = field.description.training
        self.figures = {name: training[name] for name in FITTED if name in training} | _identity(field, kept.data)
        self.figures["stamp_ns"] = kept.stamp_ns
        return self.figures

    def submit(self, scan: NewScan, config: FitConfig, *, warm_start: bool, restart: bool) -> bool:
        """Show a C-scan if it has not been shown, and fit it; return whether it has to wait for another fit.

        Args:
            scan: the C-scan.
            config: of the fit.
            warm_start: begin with the last fitted field, if it can.
            restart: end the fit that runs now, in favour of this one.
        """
        waits = self._worker.submit(lambda cancelled: self._job(scan, config, warm_start, cancelled), restart=restart)
        if waits and not restart:
            values = {"state": "waiting", "stamp_ns": scan.volume.stamp_ns}
            self._progress.report(status.OK, "a fit is running; this C-scan is next", values)
        return waits

    def cancel(self) -> int:
        """End the running fit and forget the waiting one; return how many there were."""
        return self._worker.cancel()

    def close(self) -> None:
        """End everything."""
        self._worker.close(EXIT_WAIT_S)

    def _job(self, scan: NewScan, config: FitConfig, warm_start: bool, cancelled: Callable[[], bool]) -> None:
        volume = scan.volume
        of_scan = {"stamp_ns": volume.stamp_ns}
        try:
            if not cancelled():
                self.show(scan)
            shape = " x ".join(str(n) for n in volume.geometry.shape)
            self._progress.report(status.OK, f"fitting a C-scan of {shape} voxels", {"state": "fitting", **of_scan})
            result = fit(
                volume,
                config,
                device=self._device,
                progress=lambda progress: self._report(progress, volume.stamp_ns),
                cancelled=cancelled,
                start=self._start_field(scan, config) if warm_start else None,
            )
            figures = {**of_scan, "steps": result.steps, "seconds": result.seconds, "ended": result.ended}
            if not result.cancelled and not cancelled():
                self._publish(scan, result, figures)
            elif self._present.is_of(scan):
                self._progress.report(status.WARN, "fit cancelled", {"state": "cancelled", **figures})
            else:
                self._supersede(figures)
        except Exception as error:  # whatever goes wrong in a fit, out of memory included, the node lives on
            if self._worker.closed:
                return  # the node did not wait for this fit and took its publishers along
            self._failed(f"fit failed: {error}")
            self._progress.report(status.ERROR, f"fit failed: {error}", {"state": "failed", **of_scan})
        give_back_freed_memory()  # a fit needs several times what its field is

    def show(self, scan: NewScan) -> None:
        """Publish what is known of a C-scan at once, unless that has been done, and say so."""
        if scan.shown:
            return
        self._present.show(scan)
        values = {"stamp_ns": scan.volume.stamp_ns, "field_kind": "interpolated", "field_hash": scan.hash}
        self._progress.report(
            status.OK, "a C-scan has come; the field through its voxels is published", {"state": "received", **values}
        )

    def _publish(self, scan: NewScan, result: FitResult, figures: dict[str, Any]) -> None:
        loss = half_precision_loss(result.field)
        stated = {"float16_rms": loss.rms, "float16_largest": loss.largest}
        described = dataclasses.replace(
            result.field.description, training={**result.field.description.training, **stated}
        )
        field = NeuralField(result.field.model, result.field.config, described)
        data = dumps_field(field, half=True)
        self._fitted = field
        if not self._running():
            return
        level, kept = status.WARN if result.ended == "diverged" else status.OK, ""
        try:
            if not self._present.show_fitted(scan, data):
                self._supersede(figures)
                return
        except CheckpointError as error:
            level, kept = status.WARN, f"; a restarted trainer will not have it: {error}"
            self._failed(str(error))
        self.figures = {**figures, "psnr_db": result.psnr_db, **stated, **_identity(field, data)}
        self._progress.report(level, _outcome(result) + kept, {"state": "done", **self.figures})

    def _supersede(self, figures: dict[str, Any]) -> None:
        words = "a newer C-scan has come meanwhile: its field stays, this one is not published"
        self._progress.report(status.WARN, words, {"state": "superseded", **figures})

    def _start_field(self, scan: NewScan, config: FitConfig) -> NeuralField | None:
        """Return the last fitted field if a fit of this scan can begin with it."""
        field, geometry = self._fitted, scan.volume.geometry
        if field is None or field.config != config.field.for_volume(geometry):
            return None
        return field if field.geometry.same_grid(geometry) else None

    def _report(self, progress: FitProgress, stamp_ns: int) -> None:
        values = {"state": "fitting", "stamp_ns": stamp_ns, **dataclasses.asdict(progress)}
        self._progress.report(status.OK, f"fitting: {progress.fraction:.0%}", values, log=False)


def _identity(field: NeuralField, data: bytes) -> dict[str, Any]:
    return {"field_kind": field.kind, "field_hash": field_hash(data), "field_bytes": len(data)}


def _outcome(result: FitResult) -> str:
    figures = f"in {result.seconds:.1f} s: {result.steps} steps, PSNR {result.psnr_db:.2f} dB"
    if result.ended == "diverged":
        return f"the fit diverged; its last good state is published, fitted {figures}"
    return f"field fitted {figures}, ended by {result.ended}"
