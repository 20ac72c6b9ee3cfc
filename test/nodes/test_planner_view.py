"""What a person sees of a plan, and which fields a planner takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from octn_ros.errors import CheckpointError
from octn_ros.field import (
    HashGridConfig,
    InterpolatedField,
    NetworkConfig,
    NeuralFieldConfig,
    dumps_field,
    field_hash,
    loads_field,
)
from octn_ros.nodes import conversions, qos, status
from octn_ros.nodes.diagnostics import TOPIC as DIAGNOSTICS
from octn_ros.nodes.field_receiver import ReceivedField, _check_values
from octn_ros.nodes.plan_preview import LINE_PX, MARGIN_PX, SIDE_PX
from octn_ros.nodes.planner import Planner
from octn_ros.planning import from_translation_quaternion
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, fit
from octn_ros.volume import Volume

TIMEOUT_S = 120.0
STAMP_NS = 4_000_000_000
OCT, BASE = "oct_optical_frame", "base_link"
FLAT = PhantomConfig(shape=(24, 96, 24), surface="flat", spacing_m=(4e-5, 1e-5, 4e-5), asymmetric=False)
RASTER = {"region.size_m": [4e-4, 3e-4], "raster.line_spacing_m": 1e-4}
COLOURED = 40  # how much the channels of a pixel differ where it is no grey


@pytest.fixture(scope="module")
def volume() -> Volume:
    return dataclasses.replace(make_phantom(FLAT).truth, stamp_ns=STAMP_NS)


class Bench:
    """The planner, and a client that plays trainer and viewer."""

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        self.status = client.watch(DiagnosticArray, "plan_status")
        self.field = client.node.create_publisher(CompressedImage, "field", qos.LATCHED)
        self.enface = client.node.create_publisher(OccupancyGrid, "enface", qos.LATCHED)
        self.scan_ee_pose = client.node.create_publisher(PoseStamped, "scan_ee_pose", qos.LATCHED)
        self.path = client.watch(Path, "path")
        self.markers = client.watch(MarkerArray, "plan_markers")
        self.preview = client.watch(Image, "plan_preview")
        self.waypoints = client.watch(PoseArray, "waypoints")
        self.node = spin(Planner, device="cpu", **parameters)

    def give(self, data: bytes, stamp_ns: int = STAMP_NS, frame: str = OCT) -> None:
        self.field.publish(conversions.to_field_message(data, stamp_ns, frame))

    def replan(self) -> Any:
        return self.client.call(Trigger, "replan", Trigger.Request(), TIMEOUT_S)

    def set(self, name: str, value: Any) -> Any:
        asked = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.client.call(SetParameters, "planner/set_parameters", asked, TIMEOUT_S).results[0]

    def until(self, *words: str) -> dict[str, str]:
        message = self.status.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))
        return status.read(message)[2]


def is_coloured(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(np.ptp(pixels.astype(int), axis=-1) > COLOURED)


def picture(message: Image) -> np.ndarray:
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)


def test_a_view_that_comes_while_a_plan_is_withdrawn_does_not_bring_it_back(
    spin: Callable[..., Any], volume: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, stamp_to_ns = spin(Planner, device="cpu")._view, conversions.stamp_to_ns
    received = ReceivedField(InterpolatedField(volume), "ab12" * 4, STAMP_NS, OCT)

    def meanwhile(stamp: Any) -> int:
        view.clear(received)
        return stamp_to_ns(stamp)

    with monkeypatch.context() as patched:
        patched.setattr(view, "_start", SimpleNamespace(reset=lambda: None))  # nothing is drawn
        view.show(received, SimpleNamespace(), None)
        patched.setattr(conversions, "stamp_to_ns", meanwhile)
        view._on_enface(OccupancyGrid(header=conversions.header(STAMP_NS, OCT)))
    assert view._shown.plan is None


def test_path_markers_and_preview_show_the_plan_until_a_new_field_comes(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, **RASTER)
    ee2base = from_translation_quaternion((0.4, -0.1, 0.3), (0.6, 0.0, 0.8, 0.0))
    bench.scan_ee_pose.publish(conversions.matrix_to_pose_stamped(ee2base, STAMP_NS, BASE))
    bench.client.wait_for(lambda: bench.node._scan_poses.ee2base(STAMP_NS) is not None, TIMEOUT_S, "scan_ee_pose")
    bench.enface.publish(conversions.to_grid(volume.array.max(axis=1).astype(np.float32), volume.geometry, STAMP_NS))
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    assert bench.replan().success
    head = conversions.header(STAMP_NS, BASE)
    path = bench.path.wait(TIMEOUT_S)
    base = client.watch(PoseArray, "waypoints_base").wait(TIMEOUT_S)
    assert path.header == base.header == head
    assert [stamped.pose for stamped in path.poses] == base.poses
    assert all(stamped.header == head for stamped in path.poses)

    markers = bench.markers.wait(TIMEOUT_S).markers
    assert [(marker.ns, marker.action) for marker in markers] == [("", Marker.DELETEALL), ("path", Marker.ADD)]
    assert markers[1].header == head
    places = {(pose.position.x, pose.position.y, pose.position.z) for pose in base.poses}
    for point in markers[1].points:
        assert min(np.linalg.norm(np.subtract((point.x, point.y, point.z), place)) for place in places) < 1e-9
    segments = 4
    assert len(markers[1].points) == len(markers[1].colors) == 2 * (len(base.poses) - segments)
    assert all(colour.g > colour.r for colour in markers[1].colors), "sure, so green"

    preview = bench.preview.wait(TIMEOUT_S)
    assert preview.header == conversions.header(STAMP_NS, OCT)
    lines = 3  # two say what the plan is, and one of what field
    height = SIDE_PX + lines * LINE_PX + 2 * MARGIN_PX
    assert (preview.height, preview.width, preview.encoding) == (height, SIDE_PX, "rgb8")
    for line in range(lines):
        words = picture(preview)[SIDE_PX + MARGIN_PX + LINE_PX * line :][:LINE_PX].max(axis=2) > 128
        assert words.any(), f"line {line} below the view is empty"
        assert not words[:, -MARGIN_PX:].any(), f"line {line} is cut"
    drawn = is_coloured(picture(preview)[:SIDE_PX])
    row, column = np.nonzero(drawn)
    # The rectangle lies in the middle of the scan: 23 * 40 um plus the half voxels on both sides.
    extent_m = 24 * 4e-5
    assert np.ptp(column) / SIDE_PX == pytest.approx(4e-4 / extent_m, abs=0.01)
    assert np.ptp(row) / SIDE_PX == pytest.approx(3e-4 / extent_m, abs=0.01)
    assert column.mean() / SIDE_PX == pytest.approx(0.5, abs=0.01)

    newer = dataclasses.replace(volume, stamp_ns=STAMP_NS + 1)
    bench.give(dumps_field(InterpolatedField(newer)), STAMP_NS + 1)
    bench.until("withdrawn")
    assert not bench.path.wait(TIMEOUT_S, lambda message: message.header.stamp.nanosec == 1).poses
    gone = bench.markers.wait(TIMEOUT_S, lambda message: message.markers[0].header.stamp.nanosec == 1)
    assert [marker.action for marker in gone.markers] == [Marker.DELETEALL]
    bare = bench.preview.wait(TIMEOUT_S, lambda message: message.header.stamp.nanosec == 1)
    assert not is_coloured(picture(bare)).any()


def test_the_preview_is_drawn_again_over_a_view_that_comes_late(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, **RASTER)
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    assert bench.replan().success
    plain = picture(bench.preview.wait(TIMEOUT_S))[:SIDE_PX]
    assert len(np.unique(plain[~is_coloured(plain)])) == 2, "plain grey, and the white ring of the start"
    rng = np.random.default_rng(0)
    view = conversions.to_grid(rng.random((24, 24), dtype=np.float32), volume.geometry, STAMP_NS + 1)
    bench.enface.publish(view)  # of another scan
    view.header.stamp = conversions.header(STAMP_NS, OCT).stamp
    bench.enface.publish(view)
    over = bench.preview.wait(TIMEOUT_S, lambda message: np.ptp(picture(message)[:40, :SIDE_PX].astype(int)) > 100)
    np.testing.assert_array_equal(is_coloured(picture(over)[:SIDE_PX]), is_coloured(plain))
    assert bench.path.wait(TIMEOUT_S).header.frame_id == "tool0", "no pose of the scan, no base"


def test_given_up_points_are_red(spin: Callable[..., Any], client: Any, volume: Volume) -> None:
    shadowed = volume.array.copy()
    shadowed[8:16, :, 8:16] = shadowed.min()  # no tissue in the middle
    bench = Bench(spin, client, **(RASTER | {"region.size_m": [8e-4, 8e-4], "envelope.max_given_up": 1.0}))
    bench.give(dumps_field(InterpolatedField(dataclasses.replace(volume, array=shadowed))))
    bench.until("ready to plan")
    answer = bench.replan()
    assert answer.success, answer.message
    figures = bench.until("hit rate")
    assert int(figures["given_up"]) > 5
    marker = bench.markers.wait(TIMEOUT_S).markers[-1]
    assert (marker.ns, marker.color.r > 0.8, marker.color.g < 0.2) == ("given_up", True, True)
    assert len(marker.points) == int(figures["given_up"])
    pixels = picture(bench.preview.wait(TIMEOUT_S))[:SIDE_PX].astype(int)
    red = (pixels[..., 0] > 200) & (pixels[..., 1] < 60)
    row, column = np.nonzero(red)
    assert abs(row.mean() / SIDE_PX - 0.5) < 0.05
    assert abs(column.mean() / SIDE_PX - 0.5) < 0.05


@pytest.fixture(scope="module")
def neural(volume: Volume) -> bytes:
    """A field that has hardly been fitted."""
    small = NeuralFieldConfig(HashGridConfig(levels=2, log2_table_size=8), NetworkConfig(hidden_layers=1, neurons=8))
    return dumps_field(fit(volume, FitConfig(field=small, steps=2, batch=64)).field, half=True)


def test_a_field_of_a_lesser_kind_is_refused_and_the_last_one_kept(
    spin: Callable[..., Any], client: Any, volume: Volume, neural: bytes
) -> None:
    bench = Bench(spin, client, **RASTER, least_field_kind="neural")
    interpolated = dumps_field(InterpolatedField(volume))
    bench.give(interpolated)
    bench.until("field refused, there is none", "least_field_kind", "interpolated")
    assert "none yet" in bench.replan().message
    bench.give(neural)
    bench.until("ready to plan")
    bench.give(interpolated)
    kept = bench.until("field refused, the last one is kept", "least_field_kind")
    assert kept["field_hash"] == field_hash(neural)
    assert bench.set("least_field_kind", "interpolated").successful
    assert not bench.set("least_field_kind", "magical").successful
    bench.give(interpolated)
    bench.status.wait(TIMEOUT_S, lambda m: status.read(m)[2].get("field_hash") == field_hash(interpolated))
    assert bench.replan().success
    assert bench.until("hit rate")["field_hash"] == field_hash(interpolated)
    assert bench.set("least_field_kind", "neural").successful
    refused = bench.replan()
    assert not refused.success
    assert "kind neural" in refused.message


@pytest.mark.parametrize(
    ("stamp_ns", "frame", "parameters", "reason"),
    [
        (STAMP_NS + 1, OCT, {}, "to name its scan"),
        (STAMP_NS, "camera", {}, "to name its scan"),
        (STAMP_NS, OCT, {"largest_field_mb": 1}, "at most 1 MB"),
    ],
)
def test_a_field_that_is_not_what_its_message_says_is_refused(
    spin: Callable[..., Any], client: Any, volume: Volume, stamp_ns: int, frame: str, parameters: dict, reason: str
) -> None:
    bench = Bench(spin, client, **parameters)
    array = np.random.default_rng(0).random((64, 64, 128), dtype=np.float32)
    large = Volume.from_array(array, (1e-5,) * 3, stamp_ns=STAMP_NS)
    bench.give(dumps_field(InterpolatedField(large if parameters else volume)), stamp_ns, frame)
    bench.until("field refused, there is none", reason)


@pytest.mark.parametrize("spacing_m", [(1e-9, 1e-5, 1e-5), (10.0, 1e-5, 1e-5)])
def test_a_scan_of_no_size_that_an_oct_has_is_refused(
    spin: Callable[..., Any], client: Any, volume: Volume, spacing_m: tuple[float, float, float]
) -> None:
    bench = Bench(spin, client)
    geometry = dataclasses.replace(volume.geometry, spacing_m=spacing_m)
    bench.give(dumps_field(InterpolatedField(dataclasses.replace(volume, geometry=geometry))))
    bench.until("field refused, there is none", "are they in metres?")


def test_finite_parameters_of_infinite_intensities_are_refused(neural: bytes) -> None:
    field = loads_field(neural)
    _check_values(field)
    with torch.no_grad():
        for parameter in field.model.parameters():
            parameter.copy_(torch.full_like(parameter, 3e38))
    with pytest.raises(CheckpointError, match="not finite"):
        _check_values(field)


def test_a_field_that_is_here_already_withdraws_no_plan(spin: Callable[..., Any], client: Any, volume: Volume) -> None:
    bench = Bench(spin, client, **RASTER)
    data = dumps_field(InterpolatedField(volume))
    bench.give(data)
    bench.until("ready to plan")
    assert bench.replan().success
    bench.until("waypoints in")
    planned = len(bench.status.messages)
    bench.give(data)  # as a trainer does that starts again
    bench.give(data, stamp_ns=STAMP_NS + 1)
    bench.until("field refused", "name its scan")
    assert len(bench.status.messages) == planned + 1
    bench.waypoints.wait(TIMEOUT_S, lambda message: not message.poses, after=2)
    # The second one's stamp says that there is a newer scan, though it is refused; the first one withdrew nothing.
    assert [bool(message.poses) for message in bench.waypoints.messages] == [False, True, False]


def test_a_plan_larger_than_allowed_is_refused_before_it_is_searched(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, **RASTER, largest_plan=20)
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    assert not bench.replan().success
    assert bench.until("replan refused", "largest_plan", "36")["state"] == "refused"
    assert "read-only" in bench.set("largest_plan", 36).reason
    # What is wrong with a region that is far too large is where it lies, not how many waypoints it has.
    assert bench.set("region.size_m", [0.03, 0.03]).successful
    assert not bench.replan().success
    assert bench.until("replan refused", "inside the scan")["state"] == "refused"


def test_a_plan_as_large_as_allowed_is_made(spin: Callable[..., Any], client: Any, volume: Volume) -> None:
    bench = Bench(spin, client, **RASTER, largest_plan=36)
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    assert bench.replan().success
    assert len(bench.waypoints.wait(TIMEOUT_S, lambda message: bool(message.poses)).poses) == 36


def test_diagnostics_tell_field_age_requests_and_the_last_error(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client, **RASTER)
    health = client.watch(DiagnosticArray, DIAGNOSTICS, qos.STREAM)
    health.wait(TIMEOUT_S, lambda message: status.read(message)[1] == "no field yet")
    assert not bench.replan().success
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    assert bench.replan().success
    stands = health.wait(TIMEOUT_S, lambda message: status.read(message)[1] == "a plan stands")
    running = status.read(stands)[2]  # the sign of life that comes with the plan, before the answer
    assert (running["replan.requests"], running["replan.refused"], running["replan.running"]) == ("1", "1", "1")
    told = status.read(health.wait(TIMEOUT_S, lambda message: status.read(message)[2].get("replan.requests") == "2"))[2]
    assert (told["replan.refused"], told["replan.running"]) == ("1", "0")
    assert "none yet" in told["last_error"]
    assert float(told["field_age_s"]) > 1e6, "the scan was in 1970"


def test_a_hundred_plans_asked_at_once_are_all_answered_alike(
    spin: Callable[..., Any], client: Any, volume: Volume
) -> None:
    bench = Bench(spin, client)
    bench.give(dumps_field(InterpolatedField(volume)))
    bench.until("ready to plan")
    tool_path = client.watch(PointCloud2, "tool_path")
    service = client.node.create_client(GetPlan, "plan_raster")
    assert service.wait_for_service(TIMEOUT_S)
    request = GetPlan.Request(tolerance=1e-4)
    request.start.header.frame_id = request.goal.header.frame_id = OCT
    request.start.pose.position.x = request.start.pose.position.y = 2e-4
    request.goal.pose.position.x = request.goal.pose.position.y = 6e-4
    futures = [service.call_async(request) for _ in range(100)]
    client.wait_for(lambda: all(future.done() for future in futures), 3 * TIMEOUT_S, "100 answers")
    paths = [future.result().plan for future in futures]
    assert len(paths[0].poses) == 45
    assert all(path == paths[0] for path in paths)
    tool_path.wait(TIMEOUT_S, lambda message: message.width == 45)
