"""The paper's data sets by their layout: small files made as each set has them, and what is not one of them."""

import nibabel
import numpy as np
import pytest
from PIL import Image

from octn_ros.errors import VolumeError
from octn_ros.evaluation import datasets
from octn_ros.evaluation.benchmark import BenchmarkRequest
from octn_ros.evaluation.scans import scan_sources, stated_spacings


@pytest.fixture
def voxels():
    return np.random.default_rng(0).integers(0, 255, (5, 16, 12), dtype=np.uint8)


def images(folder, bscans, name, first=1):
    folder.mkdir(parents=True)
    for number, bscan in enumerate(bscans, first):
        Image.fromarray(bscan).save(folder / name.format(number))


def sources(folder, spacing_um=None):
    return scan_sources(BenchmarkRequest(data=folder, spacing_um=spacing_um), (), (2, 2, 2), 0)


def test_srinivasan(tmp_path, voxels):
    for eye in ("AMD1", "DME12", "NORMAL3"):
        images(tmp_path / "Publication_Dataset" / eye / "TIFFs" / "8bitTIFFs", voxels, "{:03d}.tif")
    found = sources(tmp_path, (100.0, 3.87, 11.0))
    assert [source.name for source in found] == ["Srinivasan AMD1", "Srinivasan DME12", "Srinivasan NORMAL3"]
    volume = found[0].load().volume
    np.testing.assert_array_equal(volume.array, voxels)
    assert volume.geometry.spacing_m == pytest.approx((100e-6, 3.87e-6, 11e-6))
    request = BenchmarkRequest(spacing_um=(100.0, 3.87, 11.0))
    assert list(stated_spacings(found, request)) == [
        "Srinivasan: the spacing that was given, (100.0, 3.87, 11.0) um (bscan, axial, lateral)."
    ]


def test_a_set_without_a_spacing_asks_for_it(tmp_path, voxels):
    images(tmp_path / "AMD1" / "TIFFs" / "8bitTIFFs", voxels, "{:03d}.tif")
    with pytest.raises(VolumeError, match=r"the spacing of Srinivasan is another for every eye.*--spacing-um"):
        sources(tmp_path)[0].load()


def test_noor(tmp_path, voxels):
    """The first image of an eye with DME is no B-scan and may have another size."""
    images(tmp_path / "Data" / "AMD" / "AMD (2)", voxels, "Image ({}).png")
    images(tmp_path / "Data" / "DME" / "DME (10)", [np.zeros((7, 7), np.uint8), *voxels], "Image ({}).png")
    found = sources(tmp_path, (120.0, 3.9, 11.0))
    assert [source.name for source in found] == ["Noor AMD (2)", "Noor DME (10)"]
    for source in found:
        np.testing.assert_array_equal(source.load().volume.array, voxels)
    with pytest.raises(VolumeError, match=r"DME \(10\): the spacing of Noor is another for every eye"):
        sources(tmp_path)[1].load()


@pytest.mark.parametrize("name", ["bscans", "oct_bscans"])
def test_harvard_gdp(tmp_path, voxels, name):
    """Files with a thickness map alone are no scans; the documented spacing holds for the documented shape alone."""
    (tmp_path / "Bscan").mkdir()
    (tmp_path / "rnflt_maps").mkdir()
    whole = np.zeros((200, 200, 200), np.uint8)
    whole[:, 100:] = 9
    np.savez_compressed(tmp_path / "Bscan" / "data_0001.npz", **{name: whole}, glaucoma=1, md=-2.0)
    np.savez(tmp_path / "Bscan" / "data_0002.npz", **{name: voxels}, glaucoma=0, md=0.5)
    np.savez(tmp_path / "rnflt_maps" / "data_0001.npz", rnflt=np.zeros((225, 225)), glaucoma=1)
    found = sources(tmp_path)
    assert [source.name for source in found] == ["Harvard GDP data_0001", "Harvard GDP data_0002"]
    volume = found[0].load().volume
    np.testing.assert_array_equal(volume.array, whole)
    assert volume.geometry.spacing_m == pytest.approx((30e-6, 10e-6, 30e-6))
    with pytest.raises(VolumeError, match="the spacing of Harvard GDP"):
        found[1].load()
    np.testing.assert_array_equal(sources(tmp_path, (30.0, 10.0, 30.0))[1].load().volume.array, voxels)
    assert any("6 x 2 x 6 mm" in sentence for sentence in stated_spacings(found, BenchmarkRequest()))


def test_tissue_oct(tmp_path, monkeypatch, voxels):
    """What a file states wins over the set's spacing; other shapes and other names are none of the set's."""
    monkeypatch.setattr(datasets, "_TISSUE_OCT_SHAPE", voxels.shape)
    folder = tmp_path / "Duke_TissueOCT" / "porcine"
    folder.mkdir(parents=True)
    nibabel.save(nibabel.Nifti1Image(voxels, np.eye(4)), folder / "a.nii.gz")
    stated = nibabel.Nifti1Image(voxels, np.diag([0.04, 0.02, 0.03, 1.0]))
    stated.header.set_xyzt_units("mm")
    nibabel.save(stated, folder / "b.nii")
    nibabel.save(nibabel.Nifti1Image(voxels[:4], np.eye(4)), folder / "c.nii")
    (folder / "d.nii").write_bytes(b"rubbish")
    (tmp_path / "other").mkdir()
    nibabel.save(nibabel.Nifti1Image(voxels, np.eye(4)), tmp_path / "other" / "e.nii")
    one, two, three, four, five = sources(tmp_path)
    assert one.name == "TissueOCT Duke_TissueOCT/porcine/a.nii.gz"
    assert one.load().volume.geometry.spacing_m == pytest.approx((28e-6, 14.59e-6, 14e-6))
    np.testing.assert_array_equal(one.load().volume.array, voxels)
    assert two.load().volume.geometry.spacing_m == pytest.approx((40e-6, 20e-6, 30e-6))
    assert [source.data_set for source in (one, two)] == [datasets.TISSUE_OCT] * 2
    for source in (three, four, five):
        assert source.data_set is None
        with pytest.raises(VolumeError):
            source.load()


def test_damaged_archives_are_left_to_whoever_loads_them(tmp_path):
    (tmp_path / "data_0001.npz").write_bytes(b"PK\x03\x04 rubbish")
    source = sources(tmp_path)[0]
    assert source.data_set is None
    with pytest.raises(VolumeError, match=r"data_0001\.npz"):
        source.load()
