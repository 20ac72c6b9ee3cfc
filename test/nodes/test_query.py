"""The query node alone, on fields whose answers are known: slices, bands, points, clicks, surface, refusals."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan, LoadMap
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_srvs.srv import Trigger

from octn_ros.field import InterpolatedField, dumps_field
from octn_ros.nodes import band_publisher, conversions, qos, status
from octn_ros.nodes.point_answers import CLICKED_TOPIC, COLUMNS
from octn_ros.nodes.query import Query
from octn_ros.planning import from_translation_quaternion, load_calibration
from octn_ros.query import BandQuery, evaluate_points, find_band
from octn_ros.resources import config_path
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume

TIMEOUT_S = 120.0  # kernels may have to be compiled first
STAMP_NS = 7_000_000_123
OCT, TOOL, BASE, LASER = "oct_optical_frame", "tool0", "base_link", "laser_frame"
STEP_M, ORIGIN_M = 1e-5, (1e-3, -2e-3, 5e-4)
SLOPE_PER_M = np.array([1500.0, -700.0, 2500.0])  # by (x, y, z)
FIELDS_OF_INTENSITY = np.dtype([(name, "<f4") for name in COLUMNS])


def cubic_volume(values: Callable[..., np.ndarray], stamp_ns: int = STAMP_NS) -> Volume:
    """A small scan of cubic voxels, of a function of (x, y, z) from its origin."""
    y, z, x = np.meshgrid(*(np.arange(count) * STEP_M for count in (7, 30, 11)), indexing="ij")
    return Volume.from_array(
        values(x, y, z).astype(np.float32), (STEP_M,) * 3, intensity_range=(0.0, 1.0), origin_m=ORIGIN_M,
        stamp_ns=stamp_ns,
    )  # fmt: skip


def linear(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.asarray(0.2 + SLOPE_PER_M[0] * x + SLOPE_PER_M[1] * y + SLOPE_PER_M[2] * z)


def noise(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.random.default_rng(4).random(x.shape)


class Bench:
    """The query node, and a client that plays the trainer."""

    def __init__(self, spin: Callable[..., Any], client: Any, **parameters: Any) -> None:
        self.client = client
        self.status = client.watch(DiagnosticArray, "query_status")
        self.field = client.node.create_publisher(CompressedImage, "field", qos.LATCHED)
        self.scan_ee_pose = client.node.create_publisher(PoseStamped, "scan_ee_pose", qos.LATCHED)
        self.node = spin(Query, device="cpu", **parameters)

    def give(self, volume: Volume) -> InterpolatedField:
        """Publish the field through the voxels of a volume, and wait until the node has it."""
        field = InterpolatedField(volume)
        self.field.publish(conversions.to_field_message(dumps_field(field), volume.stamp_ns, volume.geometry.frame))
        self.until("received", str(volume.stamp_ns))
        return field

    def until(self, *words: str) -> dict[str, str]:
        message = self.status.wait(TIMEOUT_S, lambda message: all(word in status.read(message)[1] for word in words))
        return status.read(message)[2]

    def slice(self, specification: str) -> Any:
        return self.client.call(LoadMap, "query_slice", LoadMap.Request(map_url=specification), TIMEOUT_S)

    def band(self) -> Any:
        return self.client.call(Trigger, "query_band", Trigger.Request(), TIMEOUT_S)

    def set(self, *changes: tuple[str, Any]) -> list[Any]:
        """Set parameters one after another; return the result of each."""
        asked = SetParameters.Request(parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in changes])
        return list(self.client.call(SetParameters, "query/set_parameters", asked, TIMEOUT_S).results)


@pytest.fixture
def bench(spin: Callable[..., Any], client: Any) -> Bench:
    return Bench(spin, client)


def cell_centres(grid: OccupancyGrid) -> np.ndarray:
    """Return where the cells of a grid lie [rows, columns, 3], as any reader of an OccupancyGrid finds it."""
    place, turn = grid.info.origin.position, grid.info.origin.orientation
    axes = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    row, column = np.meshgrid(np.arange(grid.info.height), np.arange(grid.info.width), indexing="ij")
    flat = np.stack([column + 0.5, row + 0.5, np.zeros_like(row)], axis=-1) * grid.info.resolution
    return np.asarray(flat @ axes.T + [place.x, place.y, place.z])


@pytest.mark.parametrize(
    "specification", ["bscan:2", "bscan:3.5", "axial:17", "lateral:4.25", "plane:1.02,-1.97,0.52;1,1,0;0,0,2;0.04,0.2"]
)
def test_the_cells_of_a_slice_hold_the_fields_values_where_they_lie(bench: Bench, specification: str) -> None:
    field = bench.give(cubic_volume(noise))
    pictures = bench.client.watch(Image, "slice")
    answer = bench.slice(specification)
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    grid = answer.map
    assert grid.header == conversions.header(STAMP_NS, OCT)
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    expected = evaluate_points(field, cell_centres(grid).reshape(-1, 3)).intensity.reshape(cells.shape)
    assert cells.std() > 10
    np.testing.assert_allclose(cells, 100 * expected, atol=0.51)
    picture = pictures.wait(TIMEOUT_S)
    assert (picture.encoding, picture.header) == ("32FC1", grid.header)
    np.testing.assert_allclose(conversions.image_to_array(picture), expected, atol=1e-4)
    told = bench.until("slice", "taken")
    assert (told["quantity"], told["rows"], told["columns"]) == ("intensity", str(len(cells)), str(cells.shape[1]))


def test_the_view_from_above_is_that_of_the_voxels(bench: Bench) -> None:
    volume = cubic_volume(noise)
    bench.give(volume)
    grid = bench.slice("enface:mip").map
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    np.testing.assert_allclose(cells, 100 * volume.array.max(axis=1), atol=0.51)
    np.testing.assert_allclose(cell_centres(grid)[3, 5, :2], (1e-3 + 5e-5, -2e-3 + 3e-5), atol=1e-9)


def test_a_slice_that_cannot_be_had_is_refused_by_code_and_in_words(bench: Bench) -> None:
    codes = LoadMap.Response
    assert bench.slice("bscan:2").result == codes.RESULT_MAP_DOES_NOT_EXIST
    bench.until("query_slice refused", "none yet")
    bench.give(cubic_volume(noise))
    for specification, code, reason in (
        ("bscan", codes.RESULT_INVALID_MAP_METADATA, "expected a slice as"),
        ("bscan:7", codes.RESULT_MAP_DOES_NOT_EXIST, "from 0 to 6"),
        ("enface:side", codes.RESULT_INVALID_MAP_METADATA, "enface:mip"),
        ("plane:9,9,9;1,0,0;0,1,0;1,1", codes.RESULT_MAP_DOES_NOT_EXIST, "all lie outside"),
        ("plane:1,-2,0.5;1,0,0;0,1,0;30,30;0.01", codes.RESULT_MAP_DOES_NOT_EXIST, "limits.slice_pixels"),
        ("plane:1,-2,0.5;1,0,0;0,1,0;1e9,1e9;1e-9", codes.RESULT_MAP_DOES_NOT_EXIST, "larger step"),
    ):
        answer = bench.slice(specification)
        assert (answer.result, len(answer.map.data)) == (code, 0), specification
        bench.until("query_slice refused", reason)
    assert bench.slice("bscan:2").result == codes.RESULT_SUCCESS


def cloud_rows(message: PointCloud2, columns: int) -> np.ndarray:
    return np.frombuffer(message.data, "<f4").reshape(-1, columns)


def test_a_band_follows_its_limits_and_its_region_once_it_was_asked_for(bench: Bench) -> None:
    volume = cubic_volume(noise)
    bands = bench.client.watch(PointCloud2, "band")
    assert "none yet" in bench.band().message
    field = bench.give(volume)
    assert all(result.successful for result in bench.set(("band.low", 0.5), ("band.high", 0.75)))
    answer = bench.band()
    inside = (volume.array >= np.float32(0.5)) & (volume.array <= np.float32(0.75))
    assert answer.success
    assert answer.message.startswith(f"{inside.sum():,} points of {volume.array.size:,}")
    band = bands.wait(TIMEOUT_S)
    assert band.header == conversions.header(STAMP_NS, OCT)
    assert len(bands.messages) == 1, "nothing was published before it was asked for"
    found = find_band(field, BandQuery(0.5, 0.75))
    np.testing.assert_allclose(cloud_rows(band, 4)[:, :3], found.points_m, rtol=1e-6)
    np.testing.assert_array_equal(cloud_rows(band, 4)[:, 3], found.intensity)

    refused = bench.set(("band.low", 0.9))[0]
    assert not refused.successful
    assert "low < high, got 0.9 and 0.75" in refused.reason
    corner = [ORIGIN_M[0] + 2e-5, ORIGIN_M[1], ORIGIN_M[2]]
    assert not bench.set(("band_region.shape", "box"), ("band_region.low_m", [1.0, 1.0, 1.0]))[1].successful
    box = (("band_region.low_m", corner), ("band_region.high_m", [1.0, 1.0, 1.0]))
    assert bench.set(("band_region.shape", "scan"), box[1], box[0], ("band_region.shape", "box"))[-1].successful
    part = inside[:, :, 2:].sum()
    bands.wait(TIMEOUT_S, lambda message: message.width == part)


def test_of_a_thousand_changes_of_a_band_the_last_one_counts_and_the_node_lives(bench: Bench) -> None:
    volume = cubic_volume(noise)
    bands = bench.client.watch(PointCloud2, "band")
    bench.give(volume)
    assert bench.band().success
    results = bench.set(*(("band.low", 0.1 + 5e-4 * number) for number in range(1000)))
    assert len(results) == 1000
    assert all(result.successful for result in results)
    last = int(((volume.array >= np.float32(0.1 + 5e-4 * 999)) & (volume.array <= 1)).sum())
    bands.wait(TIMEOUT_S, lambda message: message.width == last)
    assert bench.band().message.startswith(f"{last:,} points")
    assert bands.messages[-1].width == last
    assert len(bands.messages) < 900, "most of the changes were passed over"


def test_a_band_of_the_last_field_does_not_outlive_it(bench: Bench) -> None:
    bands = bench.client.watch(PointCloud2, "band")
    bench.give(cubic_volume(noise))
    assert bench.band().success
    newer = cubic_volume(lambda x, y, z: 1.0 - noise(x, y, z), STAMP_NS + 1)
    bench.give(newer)
    count = int((newer.array >= np.float32(0.6)).sum())
    of_newer = bands.wait(TIMEOUT_S, lambda message: message.header == conversions.header(STAMP_NS + 1, OCT))
    assert of_newer.width == count


def test_a_band_of_too_many_points_is_withdrawn(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, limits__band_points=1000)
    bands = client.watch(PointCloud2, "band")
    assert bench.set(("band.low", 0.9))[0].successful
    bench.give(cubic_volume(noise))
    assert bench.band().success
    assert bands.wait(TIMEOUT_S).width > 0
    assert bench.set(("band.low", 0.1))[0].successful
    assert bands.wait(TIMEOUT_S, lambda message: message.width == 0).header == conversions.header(STAMP_NS, OCT)
    bench.until("the band is withdrawn", "at most 1,000 points")
    answer = bench.band()
    assert not answer.success
    assert "at most 1,000 points" in answer.message


def test_a_band_of_a_field_that_is_no_longer_good_enough_is_withdrawn(bench: Bench) -> None:
    bands = bench.client.watch(PointCloud2, "band")
    bench.give(cubic_volume(noise))
    assert bench.band().success
    assert all(result.successful for result in bench.set(("least_field_kind", "neural"), ("band.low", 0.9)))
    assert bands.wait(TIMEOUT_S, lambda message: message.width == 0).header == conversions.header(STAMP_NS, OCT)
    bench.until("the band is withdrawn", "least_field_kind")


def test_a_field_that_comes_during_the_first_question_for_the_band_is_answered_for_too(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, held = threading.Event(), threading.Event()

    def slow(*arguments: Any, **options: Any) -> Any:
        started.set()
        assert held.wait(TIMEOUT_S)
        return find_band(*arguments, **options)

    monkeypatch.setattr(band_publisher, "find_band", slow)
    bands = bench.client.watch(PointCloud2, "band")
    bench.give(cubic_volume(noise))
    asked = threading.Thread(target=bench.band)
    asked.start()
    assert started.wait(TIMEOUT_S)
    bench.give(cubic_volume(noise, STAMP_NS + 1))
    held.set()
    asked.join(TIMEOUT_S)
    bands.wait(TIMEOUT_S, lambda message: message.header == conversions.header(STAMP_NS + 1, OCT))


def test_a_band_whose_first_question_was_refused_is_not_published_later(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bands, publisher = bench.client.watch(PointCloud2, "band"), bench.node._band
    refresh, refreshed = publisher.refresh, threading.Event()
    monkeypatch.setattr(publisher, "refresh", lambda: (refresh(), refreshed.set()))
    assert not bench.band().success
    bench.give(cubic_volume(noise))
    # The field is reported before: a question between the two is answered and refreshed, which are two bands.
    assert refreshed.wait(TIMEOUT_S)
    assert bench.band().success
    first = bands.wait(TIMEOUT_S)
    assert bench.band().success
    bands.wait(TIMEOUT_S, after=1)
    assert [message.header for message in bands.messages] == [first.header] * 2


@pytest.mark.parametrize("name", ["limits.band_points", "limits.points", "limits.slice_pixels", "largest_field_mb"])
def test_who_can_call_services_raises_no_limit(bench: Bench, name: str) -> None:
    (result,) = bench.set((name, 2000))
    assert not result.successful
    assert "read-only" in result.reason


def ee2base() -> np.ndarray:
    return from_translation_quaternion((0.4, -0.1, 0.3), (0.6, 0.0, 0.8, 0.0))


def oct2frames() -> dict[str, np.ndarray]:
    calibration = load_calibration(config_path("calibration.yaml"))
    laser2oct = np.linalg.inv(calibration.oct2ee) @ calibration.laser2ee
    return {
        OCT: np.eye(4),
        TOOL: calibration.oct2ee,
        BASE: ee2base() @ calibration.oct2ee,
        LASER: np.linalg.inv(laser2oct),
    }


def double_cloud(points: np.ndarray, frame: str, height: int = 1) -> PointCloud2:
    """Points as float64: in the base frame float32 metres are some tenths of a micrometre."""
    fields = [PointField(name=n, offset=8 * i, datatype=PointField.FLOAT64, count=1) for i, n in enumerate("xyz")]
    width = len(points) // height
    return PointCloud2(
        header=conversions.header(99, frame), height=height, width=width, fields=fields, point_step=24,
        row_step=24 * width, data=conversions.to_bytes_field(points.astype("<f8").tobytes()),
    )  # fmt: skip


class Asker:
    """A publisher of questions by topic that waits until the node listens, and what comes back."""

    def __init__(self, bench: Bench) -> None:
        self.client = bench.client
        self.points = bench.client.node.create_publisher(PointCloud2, "query_points", qos.REQUESTS)
        self.clicks = bench.client.node.create_publisher(PointStamped, CLICKED_TOPIC, qos.REQUESTS)
        self.intensities = bench.client.watch(PointCloud2, "query_intensity", qos.REQUESTS)
        self.clicked = bench.client.watch(PointStamped, "clicked_surface")
        for publisher in (self.points, self.clicks):
            bench.client.wait_for(lambda p=publisher: p.get_subscription_count() > 0, TIMEOUT_S, publisher.topic_name)
        self.intensities.wait_matched(TIMEOUT_S)

    def ask(self, message: PointCloud2) -> np.ndarray:
        before = len(self.intensities.messages)
        self.points.publish(message)
        self.intensities.wait(TIMEOUT_S, lambda _: len(self.intensities.messages) > before)
        answer = self.intensities.messages[before]
        assert answer.header == message.header
        assert (answer.height, answer.width) == (message.height, message.width)
        return cloud_rows(answer, 7)


@pytest.mark.parametrize("frame", [OCT, TOOL, BASE, LASER])
def test_points_are_answered_in_the_frame_they_are_asked_in(bench: Bench, frame: str) -> None:
    bench.scan_ee_pose.publish(conversions.matrix_to_pose_stamped(ee2base(), STAMP_NS, BASE))
    field = bench.give(cubic_volume(linear))
    asker = Asker(bench)
    oct2frame = oct2frames()[frame]
    inside = np.array(ORIGIN_M) + np.random.default_rng(1).random((40, 3)) * field.geometry.extent_m
    inside[7] = 0.0  # nowhere near the scan
    inside[8] = np.nan
    bench.client.wait_for(lambda: bench.node._scan_poses.ee2base(STAMP_NS) is not None, TIMEOUT_S, "scan_ee_pose")
    rows = asker.ask(double_cloud(inside @ oct2frame[:3, :3].T + oct2frame[:3, 3], frame, height=4))
    outside = np.isin(np.arange(40), (7, 8))
    np.testing.assert_allclose(rows[~outside, 3], 0.2 + (inside[~outside] - ORIGIN_M) @ SLOPE_PER_M, atol=2e-5)
    gradient = oct2frame[:3, :3] @ SLOPE_PER_M
    np.testing.assert_allclose(rows[~outside, 4:], np.tile(gradient, (38, 1)), atol=3.0)
    assert np.isnan(rows[outside, 3:]).all()


def test_a_field_of_a_scanner_without_a_calibration_is_answered_for_in_its_own_frame_only(bench: Bench) -> None:
    volume = cubic_volume(linear)
    other = dataclasses.replace(volume, geometry=dataclasses.replace(volume.geometry, frame="other_probe"))
    bench.scan_ee_pose.publish(conversions.matrix_to_pose_stamped(ee2base(), STAMP_NS, BASE))
    bench.give(other)
    asker = Asker(bench)
    point = np.array([ORIGIN_M])
    for frame, oct2frame in oct2frames().items():
        asker.points.publish(double_cloud(point @ oct2frame[:3, :3].T + oct2frame[:3, 3], frame))
        bench.until("query_points refused", f"calibrated frame '{OCT}', got 'other_probe'", f"instead of '{frame}'")
    assert asker.ask(double_cloud(point, "other_probe"))[0, 3] == pytest.approx(0.2, abs=1e-5)
    assert len(asker.intensities.messages) == 1


def test_a_cloud_that_cannot_be_answered_is_refused_in_words(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, limits__points=6)
    asker = Asker(bench)
    points = np.tile(ORIGIN_M, (5, 1))
    asker.points.publish(double_cloud(points, OCT))
    bench.until("query_points refused", "none yet")
    bench.give(cubic_volume(linear))
    asker.points.publish(double_cloud(points, "map"))
    bench.until("query_points refused", "'map'")
    asker.points.publish(double_cloud(points, BASE))
    bench.until("query_points refused", "scan_ee_pose")
    cut = double_cloud(points, OCT)
    cut.data = conversions.to_bytes_field(bytes(cut.data)[:-1])
    asker.points.publish(cut)
    bench.until("query_points refused", "119 bytes")
    asker.points.publish(double_cloud(np.zeros((7, 3)), OCT))
    bench.until("query_points refused", "at most 6 points, got 7")
    assert not asker.intensities.messages
    assert asker.ask(double_cloud(points[:0], OCT)).shape == (0, 7)
    assert asker.ask(double_cloud(points[:4], OCT))[0, 3] == pytest.approx(0.2, abs=1e-5)


FLAT = PhantomConfig(shape=(24, 96, 24), surface="flat", spacing_m=(4e-5, 1e-5, 4e-5), asymmetric=False)


def test_a_click_is_answered_with_intensity_and_the_surface_below_it(bench: Bench) -> None:
    phantom = make_phantom(FLAT)
    field = bench.give(dataclasses.replace(phantom.truth, stamp_ns=STAMP_NS))
    asker = Asker(bench)
    oct2tool = oct2frames()[TOOL]
    point = np.array([4.2e-4, 5.1e-4, 6e-4])
    place = oct2tool[:3, :3] @ point + oct2tool[:3, 3]
    click = PointStamped(header=conversions.header(5, TOOL))
    click.point.x, click.point.y, click.point.z = place.tolist()
    asker.clicks.publish(click)
    told = bench.until("clicked", "below the surface")
    intensity = float(evaluate_points(field, point[None]).intensity[0])
    assert float(told["intensity"]) == pytest.approx(intensity, abs=1e-5)
    depth_m = float(phantom.surface_depth_m(point[:1], point[1:2])[0])
    assert float(told["surface_depth_m"]) == pytest.approx(depth_m, abs=2e-5)
    assert float(told["below_surface_m"]) == pytest.approx(6e-4 - depth_m, abs=2e-5)
    answer = asker.clicked.wait(TIMEOUT_S)
    assert answer.header == click.header
    found = np.linalg.inv(oct2tool) @ (answer.point.x, answer.point.y, answer.point.z, 1.0)
    np.testing.assert_allclose(found[:2], point[:2], atol=1e-9)
    assert found[2] == pytest.approx(float(told["surface_depth_m"]), abs=1e-9)
    click.point.x += 1.0
    asker.clicks.publish(click)
    bench.until("clicked_point refused")
    assert len(asker.clicked.messages) == 1


def test_the_surface_of_each_new_field_is_published_and_follows_its_parameters(bench: Bench) -> None:
    surfaces = bench.client.watch(PointCloud2, "surface")
    phantom = make_phantom(FLAT)
    bench.give(dataclasses.replace(phantom.truth, stamp_ns=STAMP_NS))
    cloud = surfaces.wait(TIMEOUT_S)
    assert cloud.header == conversions.header(STAMP_NS, OCT)
    rows = cloud_rows(cloud, 5)
    assert len(rows) == 24 * 24
    truth = phantom.surface_depth_m(rows[:, 0].astype(float), rows[:, 1].astype(float))
    assert np.median(np.abs(rows[:, 2] - truth)) < 1e-5
    assert bench.set(("surface.max_ascans", 100))[0].successful
    surfaces.wait(TIMEOUT_S, lambda message: 0 < message.width <= 100)
    assert bench.set(("surface.max_ascans", 4_194_304))[0].successful
    bench.until("no surface of the field", "surface.max_ascans")
    assert bench.set(("surface.max_ascans", 64))[0].successful
    bench.give(dataclasses.replace(phantom.truth, stamp_ns=STAMP_NS + 5))
    surfaces.wait(TIMEOUT_S, lambda message: message.header == conversions.header(STAMP_NS + 5, OCT))


def test_the_surface_of_the_last_field_does_not_outlive_it(bench: Bench) -> None:
    surfaces = bench.client.watch(PointCloud2, "surface")
    bench.give(cubic_volume(lambda x, y, z: z * 3e3))
    assert surfaces.wait(TIMEOUT_S).width > 0
    bench.give(cubic_volume(lambda x, y, z: 0.9 - z * 3e3, STAMP_NS + 1))  # the intensity never rises
    withdrawn = surfaces.wait(TIMEOUT_S, lambda message: message.header == conversions.header(STAMP_NS + 1, OCT))
    assert (withdrawn.width, len(withdrawn.data), len(withdrawn.fields)) == (0, 0, 5)
    bench.until("no surface of the field")


def test_a_late_joiner_gets_surface_and_band(bench: Bench) -> None:
    bench.give(cubic_volume(linear))
    assert bench.band().success
    for topic in ("surface", "band"):
        assert bench.client.watch(PointCloud2, topic).wait(TIMEOUT_S).width > 0


def test_a_line_of_too_many_samples_is_refused(spin: Callable[..., Any], client: Any) -> None:
    bench = Bench(spin, client, limits__line_samples=5)
    bench.give(dataclasses.replace(make_phantom(FLAT).truth, stamp_ns=STAMP_NS))
    for tolerance, samples in ((1e-4, 0), (2.5e-4, 5)):
        request = GetPlan.Request(tolerance=tolerance)
        request.start.header.frame_id = request.goal.header.frame_id = OCT
        request.start.pose.position.y = request.goal.pose.position.y = 4e-4
        request.goal.pose.position.x = 9e-4
        path = bench.client.call(GetPlan, "query_surface", request, TIMEOUT_S).plan
        assert len(path.poses) == samples, tolerance
    bench.until("query_surface refused", "limits.line_samples")
