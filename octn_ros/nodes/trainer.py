"""The trainer node: B-scan images or a file in, a fitted field out."""

from __future__ import annotations

import dataclasses
import sys
import threading
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import LoadMap
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from octn_ros.errors import OctnError, VolumeError
from octn_ros.field import NeuralField
from octn_ros.field.device import torch_device
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.answers import Answers
from octn_ros.nodes.bscan_stream import BScanStream
from octn_ros.nodes.cscan_files import CScanFiles
from octn_ros.nodes.diagnostics import NodeDiagnostics
from octn_ros.nodes.field_fitter import FITTED, FieldFitter
from octn_ros.nodes.field_store import FieldStore, store_path
from octn_ros.nodes.freed_memory import give_back_freed_memory
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.pose_history import PoseHistory, StampedPose
from octn_ros.nodes.present_scan import NewScan, PresentScan
from octn_ros.nodes.trainer_config import READ_ONLY, TrainerConfig
from octn_ros.nodes.worker import run_aside
from octn_ros.training import PRESETS
from octn_ros.training.warm_up import warm_up
from octn_ros.volume import Volume


class Trainer(Node):
    """Assembles C-scans, publishes the field through the voxels of each at once, fits a neural one in a worker thread
    and publishes that in its place, both latched on one topic.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("trainer", namespace=namespace, **options)
        self._config = ConfigParameters(self, TrainerConfig(), read_only=READ_ONLY)
        config = self._config.config()
        self._fit_config = ConfigParameters(self, PRESETS[config.preset], "fit", leave_out=("preset",))
        self._device = torch_device(config.device)
        root = Path(config.data_root).expanduser() if config.data_root else None
        self._files = CScanFiles(root, config.largest_file_bytes, config.largest_scan_voxels)
        kept_at = store_path(config.field_path, self.get_fully_qualified_name())
        self._store = FieldStore(kept_at) if kept_at else None
        self._poses = PoseHistory()
        self._accepting = threading.Lock()  # scans come from two callback groups; the last one to come stays
        self._ordering = threading.Lock()  # over which scan is the newest, and the order of its fits
        self._newest: NewScan | None = None

        self._diagnostics = NodeDiagnostics(self, self._describe)
        self._progress = status.StatusTopic(self, "fit_progress", qos.REPORTS)
        self._answers = Answers(self._diagnostics, self._progress)
        self._present = PresentScan(self, self._poses, self._largest_pose_gap_s, self._store)
        self._fitter = FieldFitter(
            self._device, self._present, self._progress, self._diagnostics.failed, self.context.ok
        )
        self._restore()
        self.create_subscription(PoseStamped, "ee_pose", self._on_ee_pose, qos.STREAM)
        self._stream = BScanStream(
            self, self._config.config, self._poses, self._accept, self._on_bad_cscan, self._on_doubt
        )
        self.create_service(
            LoadMap,
            "load_cscan",
            self._load_cscan,
            qos_profile=qos.SERVICES,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        self.create_service(Trigger, "refit", self._refit, qos_profile=qos.SERVICES)
        # In a group of its own: it waits for nothing.
        self.create_service(
            Trigger, "cancel", self._cancel, qos_profile=qos.SERVICES, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self.get_logger().info(f"ready: preset {config.preset}, device {self._device}")
        fit_config = self._fit_config.config()
        run_aside(lambda: warm_up(fit_config, self._device), "warm-up")

    def destroy_node(self) -> None:
        """Cancel the fit and withdraw the node from the graph."""
        self._fitter.close()
        super().destroy_node()

    # --- C-scans

    def _on_bad_cscan(self, reason: str) -> None:
        self._diagnostics.failed(reason)
        self._progress.report(status.ERROR, reason, {"state": "refused"})

    def _on_doubt(self, reason: str) -> None:
        self._progress.report(status.WARN, reason, {"state": "unplaced"})

    def _accept(self, volume: Volume) -> NewScan:
        """Make a C-scan the newest, publish what is known of it and fit it, now or after the present fit."""
        config = self._config.config()
        with self._accepting:
            give_back_freed_memory()  # of images or a file's reader, before as much is needed again
            # All that can fail comes first, so that a failure leaves the last scan in place.
            scan = NewScan.of(volume)
            with self._ordering:
                self._newest = scan
                self._present.expect(scan)
                restart = config.new_scan == "restart"
                if restart or not self._fitter.busy:
                    self._fitter.show(scan)
                self._submit(scan, restart=restart)
        return scan

    def _submit(self, scan: NewScan, *, restart: bool) -> bool:
        warm_start = self._config.config().warm_start
        return self._fitter.submit(scan, self._fit_config.config(), warm_start=warm_start, restart=restart)

    def _largest_pose_gap_s(self) -> float:
        return self._config.config().largest_pose_gap_s

    def _on_ee_pose(self, message: PoseStamped) -> None:
        try:
            pose = conversions.pose_to_matrix(message.pose)
            stamped = StampedPose(conversions.stamp_to_ns(message.header.stamp), pose, message.header.frame_id)
            back_s = self._poses.add(stamped)
            if back_s:
                self._present.settle()
                self.get_logger().warning(
                    f"ee_pose: its stamp lies {back_s:.1f} s before that of the last one; the poses until then are "
                    "forgotten. Was a clock set back, or does another node publish ee_pose?",
                    throttle_duration_sec=5.0,
                )
            self._present.see_pose(stamped)
        except OctnError as error:
            self._diagnostics.failed(f"ee_pose: {error}")
            self.get_logger().warning(f"ee_pose: {error}", throttle_duration_sec=5.0)

    # --- services

    def _load_cscan(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        self._answers.to("load_cscan", lambda: self._load(request.map_url, response))
        return response

    def _load(self, url: str, response: LoadMap.Response) -> None:
        try:
            path = self._files.locate(url)
            if not path.exists():
                response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
                raise VolumeError(f"{path}: no such file or folder; expected a C-scan, as a path or a file:// URL")
            response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
            volume = self._files.read(path, self._config.config().file_spacing_um)
            response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
            stamp_ns = volume.stamp_ns or self.get_clock().now().nanoseconds
            response.map = self._accept(dataclasses.replace(volume, stamp_ns=stamp_ns)).grid
            response.result = LoadMap.Response.RESULT_SUCCESS
        except OSError as error:
            raise VolumeError(str(error)) from error
        except MemoryError as error:
            raise VolumeError("the C-scan does not fit into memory; lower largest_scan_voxels") from error

    def _refit(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._diagnostics.request("refit") as asked:
            restart = self._config.config().new_scan == "restart"
            with self._ordering:  # no newer scan comes in between, whose fit this one would displace
                scan = self._newest
                waits = scan is not None and self._submit(scan, restart=restart)
            if scan is None:
                response.message = "there is no C-scan to fit; scan one, or load one with load_cscan"
                asked.refused(response.message)
                self._progress.report(status.ERROR, f"refit refused: {response.message}", {"state": "refused"})
                return response
            response.success = True
            if not waits:
                response.message = "the fit has begun"
            elif restart:
                response.message = "the present fit is given up, and this one begins"
            else:
                response.message = "the present fit ends first, then this one begins"
        return response

    def _cancel(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._diagnostics.request("cancel"):
            jobs = self._fitter.cancel()
            response.success = jobs > 0
            response.message = ("no fit is running", "the fit is being cancelled", "both fits are cancelled")[jobs]
            if jobs == 2:
                response.message += "; refit fits the C-scan that waited"
        return response

    # --- the kept field, and the node's state

    def _restore(self) -> None:
        """Publish the field that was kept on disk, with the stamp of its scan; a damaged one is only reported."""
        if self._store is None:
            return
        self._store.clear_leftovers()
        try:
            kept = self._store.load()
            if kept is None:
                return
            field = kept.load()
            self._present.show_kept(kept, field.description)
        except OctnError as error:
            self._diagnostics.failed(str(error))
            self._progress.report(status.WARN, f"no kept field: {error}", {"state": "not restored"})
            return
        figures = self._fitter.start_from(field, kept) if isinstance(field, NeuralField) else {}
        age_s = self._diagnostics.age_s(kept.stamp_ns)
        self._progress.report(
            status.WARN,  # whoever takes the first field that comes plans on an old scan
            f"the field kept in {self._store.path} is published again; its scan is {age_s:.0f} s old, and holds until "
            "a new one comes",
            {"state": "restored", "age_s": age_s, **figures},
        )

    def _describe(self) -> tuple[bytes, str, dict[str, Any]]:
        known = self._present.known
        state = ", ".join(filter(None, (self._stream.state, "fitting" if self._fitter.busy else ""))) or "idle"
        values: dict[str, Any] = {
            "state": state,
            "device": str(self._device),
            "field_path": str(self._store.path) if self._store else "",
            "bscans_received": self._stream.received,
            "cscans_refused": self._stream.refusals,
            "ee_poses_kept": len(self._poses),
        }
        if known is None:
            return status.OK, f"no C-scan yet; {state}", values
        age_s = self._diagnostics.age_s(known.stamp_ns)
        values |= {
            "scan_stamp_ns": known.stamp_ns,
            "scan_age_s": age_s,
            "field_kind": known.kind,
            "field_hash": known.hash,
        }
        figures = self._fitter.figures
        if figures.get("field_hash") == known.hash:
            values |= {f"fit.{name}": figures[name] for name in FITTED if name in figures}
        return status.OK, f"{known.kind} field of a scan {age_s:.0f} s ago; {state}", values


def main(args: list[str] | None = None) -> int:
    """Run the trainer as a process."""
    return process.run(Trainer, args)


if __name__ == "__main__":
    sys.exit(main())
