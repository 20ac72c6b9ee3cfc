"""The trainer node: B-scan images or a file in, a fitted field out."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote, urlparse

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from octn_ros.errors import OctnError, VolumeError
from octn_ros.field import InterpolatedField, NeuralField, dumps_field, field_hash
from octn_ros.field.device import DEVICE_DESCRIPTION, torch_device
from octn_ros.nodes import conversions, process, qos, status
from octn_ros.nodes.bscan_pairs import BScanPairs
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.nodes.pose_history import PoseHistory, StampedPose
from octn_ros.nodes.worker import Worker, run_aside
from octn_ros.query import enface
from octn_ros.settings import check_settings, setting
from octn_ros.training import PRESETS, FitConfig, FitProgress, FitResult, fit
from octn_ros.training.warm_up import warm_up
from octn_ros.volume import OCT_FRAME, IntensityScale, Volume, load_volume
from octn_ros.volume.assembly import CScanAssembler

EXIT_WAIT_S = 0.5  # a cancelled fit ends after its present step; longer than that nobody waits for it


@dataclass(frozen=True)
class TrainerConfig:
    """What the trainer has to be told about its surroundings."""

    preset: str = setting("fast", "preset that the defaults of fit.* come from", choices=tuple(PRESETS))
    device: str = setting("auto", DEVICE_DESCRIPTION)
    bscan_count: int = setting(0, "B-scans of a C-scan on the topic bscan; 0 = not stated, none is taken", low=0)
    spacing_um: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "voxel spacing (bscan, axial, lateral) of the B-scans, and of files that state none; 0 = not stated",
        unit="um",
        low=0.0,
    )
    intensity_scale: str = setting(
        "unknown", "what the B-scans' grey values are of the reflected power", choices=("linear", "log", "unknown")
    )
    warm_start: bool = setting(
        False, "begin the fit of a C-scan with the last fitted field, if the scans agree in shape and spacing"
    )
    largest_pose_gap_s: float = setting(
        0.5, "an ee_pose further than this from the scan's stamp does not count as the scan's", unit="s", low=0.0
    )

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def spacing_m(self) -> tuple[float, float, float] | None:
        """The spacing in metres, None if it is not stated."""
        if not all(self.spacing_um):
            return None
        bscan, axial, lateral = (value * 1e-6 for value in self.spacing_um)
        return bscan, axial, lateral


@dataclass(frozen=True)
class Scan:
    """A complete C-scan and the end effector's pose nearest to its stamp (None if unknown)."""

    volume: Volume
    pose: StampedPose | None = None

    def gap_ns(self, pose: StampedPose) -> int:
        """Return how far from the scan's stamp a pose was taken."""
        return abs(pose.stamp_ns - self.volume.stamp_ns)


class Trainer(Node):
    """Assembles C-scans, publishes the field through the voxels of each at once, fits a neural one in a worker thread
    and publishes that in its place, both latched on one topic.

    Keyword arguments other than the namespace are those of `rclpy.node.Node`.
    """

    def __init__(self, *, namespace: str = "octn", **options: Any) -> None:
        super().__init__("trainer", namespace=namespace, **options)
        self._config = ConfigParameters(self, TrainerConfig(), read_only=("preset", "device"))
        config = self._config.config()
        self._fit_config = ConfigParameters(self, PRESETS[config.preset], "fit", leave_out=("preset",))
        self._device = torch_device(config.device)
        self._assembler: CScanAssembler | None = None
        self._assembled_with: tuple[Any, ...] = ()
        self._pairs, self._poses = BScanPairs(), PoseHistory()
        self._accepting = threading.Lock()  # scans come from two callback groups; the last one to come stays
        self._publishing = threading.Lock()  # held from the question which scan is the present one to the answer
        self._scan: Scan | None = None
        self._fitted: NeuralField | None = None  # the last one, of the worker's thread alone
        self._last_drop = "", 0
        self._worker = Worker("fit")

        self._progress = status.StatusTopic(self, "fit_progress", qos.STREAM)
        self._field = self.create_publisher(CompressedImage, "field", qos.LATCHED)
        self._scan_ee_pose = self.create_publisher(PoseStamped, "scan_ee_pose", qos.LATCHED)
        self._enface = self.create_publisher(OccupancyGrid, "enface", qos.LATCHED)
        scans, files = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        profile = qos.scan_profile(config.bscan_count)
        self.create_subscription(Image, "bscan", self._on_bscan, profile, callback_group=scans)
        self.create_subscription(PoseStamped, "bscan_pose", self._on_bscan_pose, profile, callback_group=scans)
        self.create_subscription(PoseStamped, "ee_pose", self._on_ee_pose, qos.STREAM)
        self.create_service(LoadMap, "load_cscan", self._load_cscan, callback_group=files)
        self.create_service(Trigger, "refit", self._refit)
        # In a group of its own: it waits for nothing.
        self.create_service(Trigger, "cancel", self._cancel, callback_group=MutuallyExclusiveCallbackGroup())
        self.get_logger().info(f"ready: preset {config.preset}, device {self._device}")
        fit_config = self._fit_config.config()
        run_aside(lambda: warm_up(fit_config, self._device), "warm-up")

    def destroy_node(self) -> None:
        """Cancel the fit and withdraw the node from the graph."""
        self._worker.close(EXIT_WAIT_S)
        super().destroy_node()

    # --- C-scans from B-scans

    def _on_bscan(self, message: Image) -> None:
        self._on_pair(self._pairs.add_image(message))

    def _on_bscan_pose(self, message: PoseStamped) -> None:
        self._on_pair(self._pairs.add_pose(message))

    def _on_pair(self, pair: tuple[Image, PoseStamped] | None) -> None:
        if pair is None:
            return
        image, pose = pair
        try:
            volume = self._assemble(image, pose)
            if volume is not None:
                self._accept(volume)
        except OctnError as error:
            self._drop(f"C-scan dropped: {error}")
        except Exception as error:  # a fault of ours, or memory that ran out: the node lives on
            self._drop(f"C-scan dropped: {_fault(error)}")

    def _drop(self, reason: str) -> None:
        """Report why a B-scan was not taken; the same reason for the next hundreds of them is said once a second."""
        now_ns = self.get_clock().now().nanoseconds
        if reason != self._last_drop[0] or now_ns - self._last_drop[1] > 1_000_000_000:
            self._last_drop = reason, now_ns
            self._progress.report(status.ERROR, reason, {"state": "refused"})

    def _assemble(self, image: Image, pose: PoseStamped) -> Volume | None:
        config = self._config.config()
        if config.bscan_count < 1 or config.spacing_m is None:
            raise VolumeError(
                "expected the parameters bscan_count and spacing_um (bscan, axial, lateral) to state what the scanner "
                f"sends, got bscan_count {config.bscan_count} and spacing_um {config.spacing_um}; set both"
            )
        scale = cast(IntensityScale, config.intensity_scale)  # one of them, as its choices say
        described = (config.bscan_count, config.spacing_m, scale)
        if self._assembler is None or described != self._assembled_with:
            self._assembler, self._assembled_with = CScanAssembler(*described), described
        if pose.header.frame_id != OCT_FRAME:
            raise VolumeError(f"expected bscan_pose in the frame {OCT_FRAME}, got {pose.header.frame_id!r}")
        image2oct = conversions.pose_to_matrix(pose.pose)
        stamp_ns = conversions.stamp_to_ns(image.header.stamp)
        return self._assembler.add(conversions.image_to_array(image), image2oct, stamp_ns)

    def _on_ee_pose(self, message: PoseStamped) -> None:
        try:
            pose = conversions.pose_to_matrix(message.pose)
        except OctnError as error:
            self.get_logger().warning(f"ee_pose ignored: {error}", throttle_duration_sec=5.0)
            return
        stamped = StampedPose(conversions.stamp_to_ns(message.header.stamp), pose, message.header.frame_id)
        self._poses.add(stamped)
        with self._publishing:
            # It may be nearer to the scan than those that had come before the scan was complete.
            if self._place(stamped):
                self._publish_pose()

    # --- C-scans from files

    def _load_cscan(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        try:
            path = _path_of(request.map_url)
            if not path.exists():
                response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
                raise VolumeError(f"{path}: no such file or folder; expected a C-scan, as a path or a file:// URL")
            response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
            volume = self._read(path)
            response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
            response.map = self._accept(volume)
            response.result = LoadMap.Response.RESULT_SUCCESS
        except (OctnError, OSError) as error:
            self._progress.report(status.ERROR, f"load_cscan refused: {error}", {"state": "refused"})
        except MemoryError:
            self._progress.report(status.ERROR, "load_cscan refused: the file is too large", {"state": "refused"})
        except Exception as error:  # a fault of ours: the node and its callers live on
            self._progress.report(status.ERROR, f"load_cscan failed: {_fault(error)}", {"state": "failed"})
        return response

    def _read(self, path: Path) -> Volume:
        spacing = self._config.config().spacing_um
        try:
            volume = load_volume(path)
        except VolumeError:
            # The file's own spacing comes first. If it is for want of it that the file was refused, ours will do;
            # any other fault shows again.
            if not all(spacing):
                raise
            volume = load_volume(path, spacing)
        stamp_ns = volume.stamp_ns or self.get_clock().now().nanoseconds
        return dataclasses.replace(volume, stamp_ns=stamp_ns)

    # --- fits

    def _accept(self, volume: Volume) -> OccupancyGrid:
        """Make a scan the present one, publish what is known of it at once, and fit it; return its en-face view."""
        with self._accepting:
            # All that can fail comes first, so that a failure leaves the last scan in place.
            view = conversions.to_grid(enface(volume), volume.geometry, volume.stamp_ns)
            data = dumps_field(InterpolatedField(volume), half=True)
            with self._publishing:
                self._scan = Scan(volume)
                self._enface.publish(view)
                self._publish(self._scan, data)
                self._start_fit(volume)
        return view

    def _publish(self, scan: Scan, data: bytes) -> None:
        """Publish a field of the present scan while `_publishing` is held; its pose goes first, to place it."""
        volume = scan.volume
        self._place(self._poses.nearest(volume.stamp_ns, self._config.config().largest_pose_gap_s))
        self._publish_pose()
        self._field.publish(conversions.to_field_message(data, volume.stamp_ns, volume.geometry.frame))

    def _place(self, pose: StampedPose | None) -> bool:
        """Take a pose as the present scan's if it is the nearest so far; return whether. `_publishing` is held."""
        scan = self._scan
        if scan is None or pose is None:
            return False
        if scan.pose is not None and scan.gap_ns(pose) >= scan.gap_ns(scan.pose):
            return False
        if scan.gap_ns(pose) > self._config.config().largest_pose_gap_s * 1e9:
            return False
        self._scan = dataclasses.replace(scan, pose=pose)
        return True

    def _publish_pose(self) -> None:
        scan = self._scan
        if scan is not None and scan.pose is not None:
            pose, stamp_ns = scan.pose, scan.volume.stamp_ns
            self._scan_ee_pose.publish(conversions.matrix_to_pose_stamped(pose.ee2base, stamp_ns, pose.frame))

    def _start_fit(self, volume: Volume) -> bool:
        config = self._fit_config.config()
        waits = self._worker.submit(lambda cancelled: self._fit(volume, config, cancelled))
        if waits:
            values = {"state": "waiting", "stamp_ns": volume.stamp_ns}
            self._progress.report(status.OK, "a fit is running; this C-scan is next", values)
        return waits

    def _fit(self, volume: Volume, config: FitConfig, cancelled: Callable[[], bool]) -> None:
        """Fit in the worker's thread and publish from there: publishers are safe from any thread."""
        of_scan = {"stamp_ns": volume.stamp_ns}
        try:
            shape = " x ".join(str(n) for n in volume.geometry.shape)
            self._progress.report(status.OK, f"fitting a C-scan of {shape} voxels", {"state": "fitting", **of_scan})
            result = fit(
                volume,
                config,
                device=self._device,
                progress=lambda progress: self._report(progress, volume.stamp_ns),
                cancelled=cancelled,
                start=self._start_field(volume, config),
            )
            figures = {**of_scan, "steps": result.steps, "seconds": result.seconds, "ended": result.ended}
            if result.cancelled or cancelled():
                self._progress.report(status.WARN, "fit cancelled", {"state": "cancelled", **figures})
                return
            self._publish_fitted(volume, result, figures)
        except Exception as error:  # whatever goes wrong in a fit, out of memory included, the node lives on
            self._progress.report(status.ERROR, f"fit failed: {error}", {"state": "failed", **of_scan})

    def _publish_fitted(self, volume: Volume, result: FitResult, figures: dict[str, Any]) -> None:
        data = dumps_field(result.field, half=True)
        self._fitted = result.field
        if not self.context.ok():
            return
        with self._publishing:
            scan = self._scan
            current = scan is not None and scan.volume is volume
            if scan is not None and current:
                self._publish(scan, data)
        if not current:
            words = "a newer C-scan has come meanwhile: its field stays, this one is not published"
            self._progress.report(status.WARN, words, {"state": "superseded", **figures})
            return
        self._progress.report(
            status.WARN if result.ended == "diverged" else status.OK,
            _outcome(result),
            {
                "state": "done",
                **figures,
                "psnr_db": result.psnr_db,
                "field_hash": field_hash(data),
                "field_bytes": len(data),
            },
        )

    def _start_field(self, volume: Volume, config: FitConfig) -> NeuralField | None:
        """Return the last fitted field if a fit of this scan shall and can begin with it."""
        field, geometry = self._fitted, volume.geometry
        if field is None or not self._config.config().warm_start or field.config != config.field.for_volume(geometry):
            return None
        return field if field.geometry.same_grid(geometry) else None

    def _report(self, progress: FitProgress, stamp_ns: int) -> None:
        values = {"state": "fitting", "stamp_ns": stamp_ns, **dataclasses.asdict(progress)}
        self._progress.report(status.OK, f"fitting: {progress.fraction:.0%}", values, log=False)

    def _refit(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._publishing:  # no newer scan comes in between, whose fit this one would displace
            scan = self._scan
            waits = scan is not None and self._start_fit(scan.volume)
        if scan is None:
            response.message = "there is no C-scan to fit; scan one, or load one with load_cscan"
            self._progress.report(status.ERROR, f"refit refused: {response.message}", {"state": "refused"})
            return response
        response.success = True
        response.message = "the present fit ends first, then this one begins" if waits else "the fit has begun"
        return response

    def _cancel(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._worker.cancel()
        response.message = "the fit is being cancelled" if response.success else "no fit is running"
        return response


def _outcome(result: FitResult) -> str:
    figures = f"in {result.seconds:.1f} s: {result.steps} steps, PSNR {result.psnr_db:.2f} dB"
    if result.ended == "diverged":
        return f"the fit diverged; its last good state is published, fitted {figures}"
    return f"field fitted {figures}, ended by {result.ended}"


def _fault(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _path_of(url: str) -> Path:
    if not url:
        raise VolumeError("expected the path or file:// URL of a C-scan in map_url, got an empty string")
    parsed = urlparse(url)
    if parsed.scheme == "file" and parsed.netloc in ("", "localhost"):
        return Path(unquote(parsed.path))
    if "://" in url:
        raise VolumeError(f"expected a path or a file:// URL of this machine, got {url!r}")
    return Path(url)


def main(args: list[str] | None = None) -> int:
    """Run the trainer as a process."""
    return process.run(Trainer, args)


if __name__ == "__main__":
    sys.exit(main())
