"""Who stands for a plan, and why nobody does."""

import math
from dataclasses import replace

import numpy as np
import pytest

from octn_ros.simulation import LaserPath, Voucher

ONE_EACH = {"waypoints": 1, "tool_path": 1, "plan_status": 1}
VOUCHER = Voucher(ONE_EACH, 1.0, "ab12" * 4, "planner", "/octn/planner", "7", "ab12" * 4, "cd34" * 4)
PATH = LaserPath(np.eye(4)[None], np.zeros(1), np.ones(1), np.ones(1), 7, "tool0", "ab12" * 4)


def test_one_planner_that_lives_and_names_the_plan_stands_for_it():
    assert VOUCHER.why_not(PATH, 1.0) is None
    assert VOUCHER.why_nobody is None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"publishers": dict.fromkeys(ONE_EACH, 0)}, "got nobody in the graph"),
        ({"publishers": {**ONE_EACH, "waypoints": 2}}, "waypoints from 2, tool_path from 1, plan_status from 1"),
        ({"publishers": {**ONE_EACH, "plan_status": 2}}, "plan_status from 2"),
        ({"publishers": {**ONE_EACH, "plan_status": 0}}, "nobody in the graph who publishes plan_status;"),
        ({"plan_hash": "ab13" * 4}, "plan_hash ab12ab12ab12ab12, stamp_ns 7 and a field_hash, got ab13ab13ab13ab13, 7"),
        ({"plan_hash": ""}, "got none, 7 and cd34"),
        ({"scan": "8"}, "got ab12ab12ab12ab12, 8 and"),
        ({"scan": ""}, "got ab12ab12ab12ab12, none and"),
        ({"field_hash": ""}, "7 and none; plan again"),
        (
            {"silent_s": 1.1},
            "(node /octn/planner) on /diagnostics with plan_hash ab12ab12ab12ab12 every 1 s, got none for 1.1",
        ),
        ({"silent_s": 1.1, "node": ""}, "node not named in plan_status"),
        ({"lives_for": "ab13" * 4}, "every 1 s, got one with ab13ab13ab13ab13; plan again"),
        ({"lives_for": ""}, "every 1 s, got one with none;"),
        ({"silent_s": math.inf}, "got none yet"),
        ({"silent_s": math.nan}, "got none yet"),
    ],
)
def test_each_lack_alone_is_told(changes, reason):
    assert reason in replace(VOUCHER, **changes).why_not(PATH, 1.0)


def test_a_plan_without_a_name_is_nobodys():
    assert "plan again" in replace(VOUCHER, plan_hash="").why_not(replace(PATH, hash=""), 1.0)


def test_of_a_planner_that_was_never_heard_of_nothing_is_known():
    assert "got none, none and none" in Voucher(ONE_EACH).why_not(PATH, 1.0)
    assert "got nobody in the graph" in Voucher({}).why_not(PATH, 1.0)
