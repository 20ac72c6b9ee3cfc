"""The platform without ROS: what it fires, at what, why it stops, and what it writes down."""

import json
from dataclasses import replace

import numpy as np
import pytest

from octn_ros.errors import ExecutionError
from octn_ros.simulation import (
    ArmConfig,
    AuditRecord,
    InaccuracyConfig,
    InterlockConfig,
    LaserConfig,
    LaserPath,
    Mounting,
    PhantomConfig,
    PhantomTissue,
    Station,
    TissueMotionConfig,
    Voucher,
    default_audit_path,
    make_phantom,
)

NOW_NS = 5_000_000_000
PERIOD_S = 0.008
CONFIG = PhantomConfig(shape=(40, 64, 80), surface="flat", surface_depth_m=3e-4)
LASER = LaserConfig()
OPERATOR = "A. Surgeon"
VOUCHER = Voucher({"waypoints": 1}, 0.5, "1" * 16, "planner", "/octn/planner", str(NOW_NS), "1" * 16, "f" * 16)
NOBODY = Voucher({"waypoints": 0})
INTERLOCK = InterlockConfig()
HOME = np.array([[1.0, 0, 0, 0.4], [0, -1, 0, 0.1], [0, 0, -1, 0.3], [0, 0, 0, 1]])
OCT2EE = np.array([[0.0, -1, 0, 0.04], [1, 0, 0, -0.02], [0, 0, 1, 0.13], [0, 0, 0, 1]])
STILL = TissueMotionConfig(tracker_noise_m=0.0)


def raster(side=4, spacing_m=75e-6):
    """A zigzag on the flat surface about the middle of the scan, planned exactly."""
    rows, columns = np.divmod(np.arange(side * side), side)
    columns = np.where(rows % 2 == 0, columns, side - 1 - columns)
    poses = np.tile(np.eye(4), (side * side, 1, 1))
    poses[:, 0, 3] = 0.45e-3 + spacing_m * columns
    poses[:, 1, 3] = 0.45e-3 + spacing_m * rows
    poses[:, 2, 3] = 3e-4
    on, speed = np.ones(side * side, bool), np.full(side * side, 5e-3)
    return LaserPath(OCT2EE @ poses, rows, on, speed, NOW_NS, "tool0", "1" * 16)


def station(tmp_path, tissue=None, motion=STILL, **errors):
    mounting = Mounting(OCT2EE, OCT2EE, HOME)
    made = Station(
        mounting,
        ArmConfig(),
        InaccuracyConfig(**errors),
        motion,
        PhantomTissue(CONFIG) if tissue is None else tissue,
        AuditRecord(tmp_path / "folder" / "audit.jsonl"),
        NOW_NS,
    )
    made.begin_scan(NOW_NS, "5" * 16, np.zeros(3))
    made.enabled = True
    made.stage(raster())
    return made


def run(made, steps=10_000, voucher=lambda step: VOUCHER, interlock=INTERLOCK):
    """Execute; return the reason of a stop, and the time at the end."""
    made.execute(OPERATOR, LASER, interlock, VOUCHER, NOW_NS, 1.0)
    now_ns = NOW_NS
    for step in range(steps):
        now_ns += round(PERIOD_S * 1e9)
        reason = made.step(PERIOD_S, interlock, voucher(step), now_ns, 1.0)
        if made.arm.state != "executing":
            return reason, now_ns
    return None, now_ns


def lines(tmp_path, event):
    text = (tmp_path / "folder" / "audit.jsonl").read_text()
    return [line for line in map(json.loads, text.splitlines()) if line["event"] == event]


def test_an_execution_cuts_the_tissue_and_is_written_down(tmp_path):
    made = station(tmp_path)
    assert run(made)[0] is None
    (begun,), shots, (end,) = (lines(tmp_path, event) for event in ("execute", "shot", "end"))
    assert begun["time_ns"] == NOW_NS
    assert begun["operator"] == "A. Surgeon"
    assert (begun["planner"], begun["scan_hash"], begun["field_hash"]) == ("planner", "5" * 16, "f" * 16)
    assert begun["plan_hash"] == end["plan_hash"] == raster().hash
    assert begun["laser"]["power_w"] == LASER.power_w
    assert [shot["waypoint"] for shot in shots] == list(range(16))
    times = [shot["time_ns"] for shot in shots]
    assert times == sorted(times)
    assert NOW_NS < times[0] < times[-1] < end["time_ns"]
    assert all(shot["dwell_s"] == pytest.approx(LASER.dwell_s) for shot in shots)
    assert all(shot["power_w"] == LASER.power_w for shot in shots)
    planned = np.array([shot["planned_m"] for shot in shots])
    np.testing.assert_allclose(planned, (np.linalg.inv(OCT2EE) @ raster().waypoints_ee)[:, :3, 3], atol=1e-9)
    # At both ends of a line the burst lies inside the line: a few micrometres.
    off = np.linalg.norm(np.array([shot["actual_m"] for shot in shots]) - planned, axis=1)
    assert off.max() < 10e-6
    assert end["outcome"] == "done"
    assert end["shots"] == 16
    assert end["spot_error_max_um"] == pytest.approx(1e6 * off.max(), abs=0.01)
    volume = 16 * float(LASER.removed_volume_m3(LASER.dwell_s))
    assert made.tissue.removed_volume_m3 == pytest.approx(volume, rel=1e-3)
    assert end["removed_volume_mm3"] == pytest.approx(1e9 * volume, rel=1e-3)
    assert end["removed_depth_max_um"] == pytest.approx(1e6 * made.tissue.removed_m.max())
    assert made.figures()["shots"] == 16


def test_errors_of_the_platform_show_as_errors_of_the_spots(tmp_path):
    made = station(tmp_path, calibration_error_m=40e-6, pose_noise_m=4e-6, seed=2)
    run(made)
    shots = lines(tmp_path, "shot")
    off = np.array([shot["actual_m"] for shot in shots]) - np.array([shot["planned_m"] for shot in shots])
    # The focus misses by the calibration's shift, and about that by the arm's noise.
    assert np.linalg.norm(off.mean(axis=0)) == pytest.approx(40e-6, abs=6e-6)
    assert 1e-6 < off.std(axis=0).mean() < 8e-6
    figures = made.figures()
    assert figures["spot_error_rms_um"] == pytest.approx(1e6 * np.sqrt((off[:, :2] ** 2).sum(1).mean()), rel=0.01)
    assert figures["focus_error_rms_um"] == pytest.approx(1e6 * np.sqrt((off[:, 2] ** 2).mean()), rel=0.01)
    x = np.arange(80) * CONFIG.spacing_m[2]
    centre = (made.tissue.removed_m.sum(axis=0) * x).sum() / made.tissue.removed_m.sum()
    assert centre == pytest.approx(0.45e-3 + 1.5 * 75e-6 + off[:, 0].mean(), abs=2e-6)


def test_tissue_that_moves_a_little_is_hit_beside_the_plan(tmp_path):
    made = station(tmp_path)
    made.move_tissue(TissueMotionConfig(shift_m=(60e-6, 0.0, 0.0), tracker_noise_m=0.0), NOW_NS)
    assert run(made)[0] is None
    shots = lines(tmp_path, "shot")
    off = np.array([shot["actual_m"] for shot in shots]) - np.array([shot["planned_m"] for shot in shots])
    np.testing.assert_allclose(off.mean(axis=0), [-60e-6, 0.0, 0.0], atol=2e-6)


def test_nothing_is_fired_unless_everything_is_well(tmp_path):
    made = station(tmp_path)
    for change, interlock, voucher, reason in (
        ({"enabled": False}, INTERLOCK, VOUCHER, "enable_laser"),
        ({}, InterlockConfig(plan_max_age_s=0.5), VOUCHER, "got one of 1.0 s"),
        ({}, INTERLOCK, NOBODY, "planner"),
    ):
        made.enabled = change.get("enabled", True)
        with pytest.raises(ExecutionError, match=reason):
            made.execute(OPERATOR, LASER, interlock, voucher, NOW_NS + 1_000_000_000, 1.0)
    made.move_tissue(TissueMotionConfig(shift_m=(0.0, 0.0, 150e-6), tracker_noise_m=0.0), NOW_NS)
    with pytest.raises(ExecutionError, match="150 um away"):
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS, 1.0)
    assert made.arm.state == "staged", "and the plan stands"
    assert made.execution is None


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [
        ({"voucher": lambda step: VOUCHER if step < 20 else NOBODY}, "planner"),
        ({"voucher": lambda step: replace(VOUCHER, silent_s=4.9 + step * PERIOD_S)}, "got none for 5.0 s"),
        (
            {"voucher": lambda step: replace(VOUCHER, plan_hash="12"[step > 20] * 16)},
            "got 2222222222222222, 5000000000 and",
        ),
        ({"interlock": InterlockConfig(plan_max_age_s=20 * PERIOD_S + 1e-6)}, "s old"),
        ({"drift": TissueMotionConfig(drift_m_s=(600e-6, 0.0, 0.0), tracker_noise_m=0.0)}, "um away"),
    ],
)
def test_trouble_on_the_way_turns_the_laser_off_in_the_same_step(tmp_path, trouble, reason):
    made = station(tmp_path)
    if "drift" in trouble:
        made.move_tissue(trouble.pop("drift"), NOW_NS)
    stopped, now_ns = run(made, **trouble)
    assert reason in stopped
    assert (made.arm.state, made.arm.laser_on, made.enabled) == ("aborted", False, False)
    shots, (end,) = lines(tmp_path, "shot"), lines(tmp_path, "end")
    assert 0 < len(shots) < 16
    assert (end["outcome"], end["reason"], end["shots"]) == ("aborted", stopped, len(shots))
    assert shots[-1]["time_ns"] + shots[-1]["dwell_s"] * 1e9 <= now_ns
    assert made.step(1.0, INTERLOCK, VOUCHER, now_ns, 1.0) is None
    assert len(lines(tmp_path, "shot")) == len(shots)
    with pytest.raises(ExecutionError, match="was stopped"):
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, now_ns, 1.0)


def test_a_loop_that_was_held_up_with_the_shutter_open_turns_the_laser_off(tmp_path):
    for stalled_s, interlock, reason in (
        (0.4, INTERLOCK, None),
        (0.6, InterlockConfig(longest_stall_s=0.7), None),
        (0.6, INTERLOCK, "every 0.5 s at least while the shutter is open, got none for 0.60 s"),
    ):
        made, now_ns = station(tmp_path), NOW_NS
        made.execute(OPERATOR, LASER, interlock, VOUCHER, now_ns, 1.0)
        now_ns += 2_000_000_000
        assert made.step(PERIOD_S, interlock, VOUCHER, now_ns, 1.0) is None, "the shutter is closed on the way there"
        while not made.arm.laser_on:
            assert made.arm.state == "executing"
            now_ns += round(PERIOD_S * 1e9)
            assert made.step(PERIOD_S, interlock, VOUCHER, now_ns, 1.0) is None
        now_ns += round(stalled_s * 1e9)
        stopped = made.step(5 * PERIOD_S, interlock, VOUCHER, now_ns, 1.0)
        if reason is None:
            assert (stopped, made.arm.state) == (None, "executing")
        else:
            assert reason in stopped
    assert (made.arm.state, made.arm.laser_on, made.enabled) == ("aborted", False, False)
    (end,) = lines(tmp_path, "end")
    assert (end["outcome"], end["reason"], end["time_ns"]) == ("aborted", stopped, now_ns)


def test_limits_changed_on_the_way_are_written_down_before_they_hold(tmp_path):
    made, now_ns = station(tmp_path), NOW_NS
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, now_ns, 1.0)
    (begun,) = lines(tmp_path, "execute")
    assert begun["limits"] == {
        "interlock.plan_max_age_s": 600.0,
        "interlock.max_tissue_motion_m": 100e-6,
        "interlock.longest_stall_s": 0.5,
        "interlock.planner_silence_s": 5.0,
        "time_factor": 1.0,
    }
    looser = InterlockConfig(plan_max_age_s=900.0, max_tissue_motion_m=0.0)
    stricter = InterlockConfig(plan_max_age_s=0.001)
    stopped = None
    for interlock, factor in ((INTERLOCK, 1.0), (looser, 1.0), (looser, 2.0), (looser, 2.0), (stricter, 2.0)):
        assert stopped is None
        now_ns += round(PERIOD_S * 1e9)
        stopped = made.step(PERIOD_S, interlock, VOUCHER, now_ns, factor)
    assert "0 to 0.001 s old" in stopped
    period_ns = round(PERIOD_S * 1e9)
    changes = lines(tmp_path, "change")
    assert [((line["time_ns"] - NOW_NS) / period_ns, line["name"], line["value"]) for line in changes] == [
        (2, "interlock.plan_max_age_s", 900.0),
        (2, "interlock.max_tissue_motion_m", 0.0),
        (3, "time_factor", 2.0),
        (5, "interlock.plan_max_age_s", 0.001),
        (5, "interlock.max_tissue_motion_m", 100e-6),
    ]
    text = (tmp_path / "folder" / "audit.jsonl").read_text()
    assert [json.loads(line)["event"] for line in text.splitlines()[-2:]] == ["change", "end"]


def test_a_shot_cut_short_by_an_abort_counts_for_what_it_did(tmp_path):
    for steps in range(20, 40):
        made = station(tmp_path)
        run(made, steps=steps)
        made.stop("an abort was asked for", NOW_NS + round(steps * PERIOD_S * 1e9), 1.0)
        last = lines(tmp_path, "shot")[-1]
        if last["dwell_s"] < LASER.dwell_s - 1e-9:
            break
    assert 0.0 < last["dwell_s"] < LASER.dwell_s
    assert last["removed_m3"] == pytest.approx(float(LASER.removed_volume_m3(last["dwell_s"])), rel=1e-3)


def test_a_shot_cut_short_is_one_of_the_last_look_however_late_the_stop(tmp_path):
    period_ns = round(PERIOD_S * 1e9)
    for held_up_s, reason in ((10.0, "got none for 10.0"), (-0.05, "set back by 0.05 s")):
        made, now_ns = station(tmp_path), NOW_NS
        made.move_tissue(TissueMotionConfig(drift_m_s=(5e-6, 0.0, 0.0), tracker_noise_m=0.0), NOW_NS)
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, now_ns, 1.0)
        while not made.arm.laser_on:
            now_ns += period_ns
            assert made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns, 1.0) is None
        drifted_m = 5e-6 * (now_ns - NOW_NS) * 1e-9
        assert reason in made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns + round(held_up_s * 1e9), 1.0)
        shot = lines(tmp_path, "shot")[-1]
        assert now_ns - period_ns <= shot["time_ns"] <= now_ns
        assert 0.0 < shot["dwell_s"] <= (now_ns - shot["time_ns"]) * 1e-9 + 1e-8
        assert shot["actual_m"][0] - shot["planned_m"][0] == pytest.approx(-drifted_m, abs=9e-6)


def test_shots_before_a_tolerated_delay_keep_their_times(tmp_path):
    made, now_ns = station(tmp_path), NOW_NS
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, now_ns, 1.0)
    while not made.arm.laser_on:
        now_ns += round(PERIOD_S * 1e9)
        assert made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns, 1.0) is None
    assert made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns + 300_000_000, 1.0) is None
    first = lines(tmp_path, "shot")[0]
    assert first["time_ns"] <= now_ns


def test_that_the_laser_has_fired_is_known_until_the_next_scan(tmp_path):
    made = station(tmp_path)
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS, 1.0)
    made.stop("an abort before the first shot", NOW_NS, 1.0)
    assert not made.has_fired
    made.stage(raster())
    made.enabled = True
    assert run(made)[0] is None
    assert made.has_fired
    made.stage(raster())
    assert run(made)[0] is None, "a second pass, if it is meant"
    made.begin_scan(NOW_NS, "6" * 16, np.zeros(3))
    assert not made.has_fired


def test_a_clock_set_back_does_not_make_a_staged_plan_young_again(tmp_path):
    made = station(tmp_path)
    made.move_tissue(STILL, NOW_NS + 700_000_000_000)
    with pytest.raises(ExecutionError, match=r"set back by 690\.00 s"):
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS + 10_000_000_000, 1.0)
    made.begin_scan(NOW_NS, "6" * 16, np.zeros(3))
    made.stage(raster())
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS + 10_000_000_000, 1.0)


@pytest.mark.parametrize("broken", ["stray", "tissue"])
def test_a_fault_in_a_stop_leaves_the_laser_off_and_the_record_ended(tmp_path, monkeypatch, broken):
    def fault(*_):
        raise RuntimeError("a fault of ours")

    made, now_ns = station(tmp_path), NOW_NS
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, now_ns, 1.0)
    while not made.arm.laser_on:
        now_ns += round(PERIOD_S * 1e9)
        made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns, 1.0)
    monkeypatch.setattr(*((made.arm, "_stray") if broken == "stray" else (made.tissue, "fire")), fault)
    assert made.stop("an abort was asked for", now_ns, 1.0) == "an abort was asked for; RuntimeError: a fault of ours"
    assert (made.arm.state, made.arm.laser_on, made.enabled) == ("aborted", False, False)
    (end,) = lines(tmp_path, "end")
    assert (end["outcome"], end["reason"]) == ("aborted", "an abort was asked for; RuntimeError: a fault of ours")


def test_what_has_happened_is_written_down_as_soon_as_it_can_be(tmp_path, monkeypatch):
    path = tmp_path / "audit.jsonl"
    path.write_bytes(b'{"event": "shot"}\n{"event": "sh')  # of a process that was killed
    audit = AuditRecord(path)

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("os.fsync", full)
        for event, happened in (("end", True), ("execute", False)):
            with pytest.raises(ExecutionError, match="No space left"):
                audit.write([{"event": event}], durable=True, happened=happened)
    assert path.read_bytes() == b'{"event": "shot"}\n{"event": "sh'
    audit.write([{"event": "execute", "number": 2}], durable=True)
    assert path.read_text().splitlines() == [
        '{"event": "shot"}', '{"event": "sh', '{"event": "end"}', '{"event": "execute", "number": 2}'
    ]  # fmt: skip


def test_what_cannot_be_written_down_is_not_fired(tmp_path):
    made = station(tmp_path)
    (tmp_path / "folder").write_text("a file where the record's folder would be")
    with pytest.raises(ExecutionError, match="audit record that can be written"):
        run(made)
    assert made.arm.state == "staged"
    (tmp_path / "folder").unlink()
    made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS, 1.0)
    (tmp_path / "folder" / "audit.jsonl").unlink()
    (tmp_path / "folder" / "audit.jsonl").mkdir()
    now_ns, stopped = NOW_NS, None
    while stopped is None and made.arm.state == "executing":
        now_ns += round(PERIOD_S * 1e9)
        stopped = made.step(PERIOD_S, INTERLOCK, VOUCHER, now_ns, 1.0)
    assert stopped.count("audit record that can be written") == 1
    assert made.arm.state == "aborted"


def test_without_a_path_there_is_no_record(tmp_path, monkeypatch):
    AuditRecord(None).write([{"event": "shot"}])
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    assert default_audit_path() == tmp_path / "octn_ros" / "audit.jsonl"
    monkeypatch.delenv("ROS_HOME")
    assert ".ros" in str(default_audit_path())


def test_after_an_abort_the_arm_goes_home_for_the_next_scan(tmp_path):
    made = station(tmp_path)
    assert made.at_home()
    run(made, steps=40)
    made.stop("an abort was asked for", NOW_NS, 1.0)
    assert not made.at_home()
    travel_s = made.go_home(NOW_NS)
    assert made.step(travel_s + 1e-6, INTERLOCK, VOUCHER, NOW_NS, 1.0) is None
    assert made.at_home()
    assert made.arm.state == "idle"


def test_a_new_scan_or_a_withdrawal_takes_the_plan_away(tmp_path):
    made = station(tmp_path)
    made.begin_scan(NOW_NS + 1, "6" * 16, np.zeros(3))
    with pytest.raises(ExecutionError, match="new scan has withdrawn"):
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS, 1.0)
    with pytest.raises(ExecutionError, match="another scan"):
        made.stage(raster())
    made = station(tmp_path)
    made.withdraw("the planner has withdrawn the plan")
    with pytest.raises(ExecutionError, match="planner has withdrawn"):
        made.execute(OPERATOR, LASER, INTERLOCK, VOUCHER, NOW_NS, 1.0)


def test_a_recording_is_fired_at_but_not_cut(tmp_path):
    volume = make_phantom(CONFIG).volume
    made = station(tmp_path, tissue=volume)
    assert run(made)[0] is None
    assert made.tissue is None
    assert made.shape == CONFIG.shape
    assert "removed_volume_mm3" not in made.figures()
    assert made.look(np.zeros(3), 1).volume is volume
