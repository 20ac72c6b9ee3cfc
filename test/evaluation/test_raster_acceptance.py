"""What the planner must hold on phantoms with known truth, on seeds that nothing was tuned on; slow."""

import dataclasses

import pytest

from octn_ros.evaluation.raster import phantom_rows
from octn_ros.evaluation.raster_config import SYSTEM, RasterBenchConfig
from octn_ros.simulation import ADVERSE, SMOOTH

HALF_AN_AXIAL_VOXEL_UM = 7.3
FARTHEST_UM = 73.0
CONFIG = dataclasses.replace(RasterBenchConfig(), phantoms_in_full=(), fit_s=3.0, seed=211)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def rows_of(tissue):
    rows, _ = phantom_rows(f"{tissue}{SYSTEM}", CONFIG, "cpu", {}, lambda *shown: None)
    return {(row["field"], row["method"]): row for row in rows}


@pytest.fixture(scope="module")
def smooth():
    return {tissue: rows_of(tissue) for tissue in SMOOTH}


@pytest.mark.parametrize("field", ["interpolated-gaussian", "neural-raw"])
def test_newton_on_smooth_tissue(smooth, field):
    rows = {tissue: found[field, "newton"] for tissue, found in smooth.items()}
    for tissue, row in rows.items():
        assert row["hit_rate"] >= 0.95, tissue
        assert row["given_up"] <= 0.02, tissue
        assert row["spread_um"] <= HALF_AN_AXIAL_VOXEL_UM, tissue
        assert row["max_um"] <= FARTHEST_UM, tissue
    offsets = [row["offset_um"] for row in rows.values()]
    assert max(offsets) - min(offsets) <= 15.0


@pytest.mark.parametrize("field", ["interpolated-gaussian", "neural-raw"])
def test_the_smooth_path_on_smooth_tissue(smooth, field):
    for tissue, found in smooth.items():
        row = found[field, "least_squares"]
        assert row["hit_rate"] >= 0.20, tissue
        assert row["spread_um"] <= 5.0, tissue
        assert row["max_um"] <= FARTHEST_UM, tissue
        assert row["smoothness_ratio"] <= 0.4, tissue


@pytest.mark.parametrize("tissue", ADVERSE)
def test_what_cannot_be_trusted_is_given_up(tissue):
    rows = rows_of(tissue)
    for field in ("interpolated-gaussian", "neural-raw"):
        for method in ("newton", "least_squares"):
            row = rows[field, method]
            assert row["max_um"] <= FARTHEST_UM, (field, method)
            assert row["kept_outside_artefacts"] >= 0.90, (field, method)
