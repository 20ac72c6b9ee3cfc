"""What load_cscan reads, and what it does not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.srv import LoadMap
from PIL import Image as PngImage

from octn_ros.errors import ConfigurationError, VolumeError
from octn_ros.nodes import status
from octn_ros.nodes.cscan_files import CScanFiles
from octn_ros.nodes.trainer import Trainer
from octn_ros.volume import Volume, save_volume

SPACING_UM = (28.0, 14.59, 14.0)
GOOD = LoadMap.Response.RESULT_SUCCESS
REFUSED = LoadMap.Response.RESULT_UNDEFINED_FAILURE


@pytest.fixture
def root(tmp_path: Path, volume: Volume) -> Path:
    """A data root with a C-scan in it and one beside it."""
    (tmp_path / "root" / "patient").mkdir(parents=True)
    (tmp_path / "secret").mkdir()
    for folder in (tmp_path / "root" / "patient", tmp_path / "secret"):
        save_volume(folder / "scan.nii", volume)
    return tmp_path / "root"


def files(root: Path, largest_bytes: int = 1 << 20, largest_voxels: int = 1 << 20) -> CScanFiles:
    return CScanFiles(root, largest_bytes, largest_voxels)


@pytest.mark.parametrize(
    "url",
    [
        "patient/scan.nii",
        "patient/../patient/scan.nii",
        "{root}/patient/scan.nii",
        "file://{root}/patient/scan.nii",
        "file://localhost{root}/patient/scan.nii",
    ],
)
def test_what_lies_below_the_root_is_read(root: Path, volume: Volume, url: str) -> None:
    reader = files(root)
    found = reader.read(reader.locate(url.format(root=root)), None)
    np.testing.assert_array_equal(found.array, volume.array)


@pytest.mark.parametrize(
    "url",
    [
        "../secret/scan.nii",
        "patient/../../secret/scan.nii",
        "{secret}/scan.nii",
        "file://{secret}/scan.nii",
        "file://{root}/%2e%2e/secret/scan.nii",
        "/etc/passwd",
        "{root}x/scan.nii",
        "link/scan.nii",
        "link_to_file.nii",
        "{secret}/none.nii",
    ],
)
def test_nothing_leads_out_of_the_root(root: Path, url: str) -> None:
    secret = root.parent / "secret"
    (root / "link").symlink_to(secret)
    (root / "link_to_file.nii").symlink_to(secret / "scan.nii")
    with pytest.raises(VolumeError, match="leads out of it"):
        files(root).locate(url.format(root=root, secret=secret))


def test_a_link_that_stays_below_the_root_is_followed(root: Path, volume: Volume) -> None:
    (root / "newest.nii").symlink_to(root / "patient" / "scan.nii")
    reader = files(root)
    np.testing.assert_array_equal(reader.read(reader.locate("newest.nii"), None).array, volume.array)


def test_a_root_that_is_itself_a_link_is_a_root(root: Path, volume: Volume) -> None:
    link = root.parent / "data"
    link.symlink_to(root)
    reader = files(link)
    found = reader.read(reader.locate(f"{link}/patient/scan.nii"), None)
    np.testing.assert_array_equal(found.array, volume.array)


def test_an_image_that_is_a_link_out_of_the_root_spoils_its_folder(root: Path, volume: Volume) -> None:
    folder = root / "images"
    folder.mkdir()
    for number, bscan in enumerate(volume.array):
        PngImage.fromarray(bscan).save(folder / f"bscan_{number}.png")
    reader = files(root)
    assert reader.read(reader.locate("images"), SPACING_UM).array.shape == volume.array.shape
    (folder / "bscan_3.png").rename(root.parent / "secret" / "bscan_3.png")
    (folder / "bscan_3.png").symlink_to(root.parent / "secret" / "bscan_3.png")
    with pytest.raises(VolumeError, match=r"bscan_3.png: expected images below data_root, got a link"):
        reader.read(reader.locate("images"), SPACING_UM)


def test_large_files_and_folders_are_refused_by_their_size_alone(root: Path, volume: Volume) -> None:
    scan = root / "patient" / "scan.nii"
    size = scan.stat().st_size
    reader = files(root, largest_bytes=size)
    reader.read(reader.locate("patient/scan.nii"), None)
    with pytest.raises(VolumeError, match=f"expected at most {size - 1:,} bytes, got {size:,}"):
        files(root, largest_bytes=size - 1).read(scan, None)
    with (root / "huge.nii").open("wb") as file:
        file.truncate(1 << 40)  # takes no room on the disk, and none in memory either
    with pytest.raises(VolumeError, match="bytes, got 1,099,511,627,776"):
        files(root, largest_bytes=1 << 31).read(root / "huge.nii", None)
    folder = root / "images"
    folder.mkdir()
    for number, bscan in enumerate(volume.array):
        PngImage.fromarray(bscan).save(folder / f"bscan_{number}.png")
    total = sum(path.stat().st_size for path in folder.iterdir())
    with pytest.raises(VolumeError, match=f"bytes, got {total:,}"):
        files(root, largest_bytes=total - 1).read(folder, SPACING_UM)


def test_scans_of_too_many_voxels_are_refused(root: Path, volume: Volume) -> None:
    reader = files(root, largest_voxels=volume.array.size - 1)
    with pytest.raises(VolumeError, match=f"expected at most {volume.array.size - 1:,} voxels"):
        reader.read(reader.locate("patient/scan.nii"), None)


def test_what_is_no_file_is_refused(root: Path) -> None:
    os.mkfifo(root / "pipe.nii")
    with pytest.raises(VolumeError, match="expected a file or a folder"):
        files(root).read(root / "pipe.nii", None)
    with pytest.raises(VolumeError, match="expected the path of a C-scan"):
        files(root).locate("scan\0.nii")


def test_without_a_root_nothing_is_read(root: Path) -> None:
    reader = CScanFiles(None, 1 << 20, 1 << 20)
    with pytest.raises(VolumeError, match="data_root"):
        reader.locate(str(root / "patient" / "scan.nii"))


def test_a_root_must_be_a_folder(root: Path) -> None:
    with pytest.raises(ConfigurationError, match="data_root: expected an existing folder"):
        files(root / "none")


def test_the_service_refuses_in_words_and_keeps_nothing(trainer_bench: Callable[..., Any], root: Path) -> None:
    size = (root / "patient" / "scan.nii").stat().st_size
    bench = trainer_bench(data_root=str(root), largest_file_bytes=size)
    with (root / "long.nii").open("wb") as file:
        file.truncate(size + 1)
    for url, result, reason in (
        ("../secret/scan.nii", REFUSED, "leads out of it"),
        ("long.nii", LoadMap.Response.RESULT_INVALID_MAP_DATA, f"at most {size:,} bytes"),
        ("none.nii", LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST, "no such file"),
        ("a" * 5000, REFUSED, "load_cscan refused"),
    ):
        assert bench.load(url).result == result, url
        assert status.read(bench.until("load_cscan refused", reason))[0] == status.ERROR
    assert not bench.field.messages
    assert bench.load("patient/scan.nii").result == GOOD


def test_the_service_of_a_trainer_without_a_root_refuses(trainer_bench: Callable[..., Any], root: Path) -> None:
    bench = trainer_bench(data_root="")
    assert bench.load(str(root / "patient" / "scan.nii")).result == REFUSED
    bench.until("load_cscan refused", "-p data_root:=FOLDER")


def test_a_caller_cannot_open_more_of_the_disk(trainer_bench: Callable[..., Any], root: Path) -> None:
    bench = trainer_bench(data_root=str(root))
    for name, value in (("data_root", "/"), ("largest_file_bytes", 1 << 60), ("largest_scan_voxels", 1 << 60),
                        ("field_path", "/tmp/else.zip")):  # fmt: skip
        result = bench.set(name, value)
        assert not result.successful
        assert "read-only" in result.reason


def test_a_trainer_with_a_root_that_is_none_does_not_start(ros: None) -> None:
    from rclpy.parameter import Parameter

    with pytest.raises(ConfigurationError, match="data_root"):
        Trainer(parameter_overrides=[Parameter("data_root", value="/nowhere/at/all")])
