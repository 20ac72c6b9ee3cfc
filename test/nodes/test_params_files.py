"""Parameter files as a launch file reads them, and the scan that the simulator will send by them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octn_ros.errors import ConfigurationError
from octn_ros.nodes.params_files import read_parameters, simulated_scan
from octn_ros.simulation import PhantomConfig
from octn_ros.volume import Volume, save_volume, subsample_bscans

REPOSITORY = Path(__file__).parents[2]
SECTIONS = """
/**: {ros__parameters: {operator: anyone, time_factor: 2.0}}
/**/simulator: {ros__parameters: {bscan_factor: 3, phantom: {shape: [10, 20, 30]}}}
/octn: {simulator: {ros__parameters: {operator: nested}}}
/octn/*: {ros__parameters: {phantom.spacing_m: [1.0e-5, 2.0e-5, 3.0e-5]}}
/other/simulator: {ros__parameters: {bscan_factor: 7}}
/octn/planner: {ros__parameters: {bscan_factor: 9}}
"""


def test_sections_match_by_name_and_wildcard(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(SECTIONS, encoding="utf-8")
    assert read_parameters(path, "/octn/simulator") == {
        "operator": "nested",
        "time_factor": 2.0,
        "bscan_factor": 3,
        "phantom.shape": [10, 20, 30],
        "phantom.spacing_m": [1e-5, 2e-5, 3e-5],
    }
    assert read_parameters(path, "/other/simulator")["bscan_factor"] == 7
    scan = simulated_scan(read_parameters(path, "/octn/simulator"), "", ())
    assert scan.shape == (4, 20, 30)
    assert scan.spacing_m == pytest.approx((3e-5, 2e-5, 3e-5))


def test_numbers_are_read_as_the_nodes_read_them(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text("/**: {ros__parameters: {phantom: {spacing_m: [2e-5, 1e-5, 3e-5]}}}", encoding="utf-8")
    scan = simulated_scan(read_parameters(path, "/octn/simulator"), "", ())
    assert scan.spacing_m == pytest.approx((2e-5, 1e-5, 3e-5))


def test_the_file_of_the_package_is_the_default_phantom() -> None:
    scan = simulated_scan(read_parameters(REPOSITORY / "config" / "octn.yaml", "/octn/simulator"), "", ())
    assert (scan.shape, scan.spacing_m) == (PhantomConfig().shape, PhantomConfig().spacing_m)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_file_that_is_played_counts_with_the_factor(tmp_path: Path, factor: int) -> None:
    array = np.arange(7 * 5 * 4, dtype=np.uint8).reshape(7, 5, 4)
    volume = Volume.from_array(array, (2e-5, 1e-5, 3e-5))
    save_volume(tmp_path / "scan.nii.gz", volume)
    expected = volume.geometry if factor == 1 else subsample_bscans(volume, factor).volume.geometry
    for given, argument in (({"volume_file": str(tmp_path / "scan.nii.gz")}, ""), ({}, str(tmp_path / "scan.nii.gz"))):
        scan = simulated_scan({**given, "bscan_factor": factor, "spacing_um": [0.0, 0.0, 0.0]}, argument, ())
        assert scan.shape == expected.shape
        assert scan.spacing_m == pytest.approx(expected.spacing_m)
    scan = simulated_scan({"bscan_factor": factor}, str(tmp_path / "scan.nii.gz"), (4.0, 5.0, 6.0))
    assert scan.spacing_m == pytest.approx((4e-6 * factor, 5e-6, 6e-6))


def test_of_a_file_that_is_played_the_header_is_read_alone(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.zeros((7, 5, 4), np.uint8))  # voxels that no Volume can be made of
    scan = simulated_scan({"volume_file": str(tmp_path / "scan.npy"), "bscan_factor": 2}, "", (4.0, 5.0, 6.0))
    assert scan.shape == (4, 5, 4)


@pytest.mark.parametrize("text", ["- 3", "a: [", "3"])
def test_what_is_no_parameter_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"params\.yaml: expected"):
        read_parameters(path, "/octn/simulator")
    with pytest.raises(ConfigurationError, match=r"none\.yaml"):
        read_parameters(tmp_path / "none.yaml", "/octn/simulator")
