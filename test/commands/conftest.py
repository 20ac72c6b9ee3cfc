"""A small scan with a surface, as arrays and as files."""

import numpy as np
import pytest

from octn_ros.volume import Volume, save_volume

SPACING_M = (30e-6, 15e-6, 20e-6)


def layered(shape=(14, 24, 16), seed=0):
    """A bright half space below a slightly tilted surface, with a little noise."""
    generator = np.random.default_rng(seed)
    bscan, axial, lateral = np.indices(shape, dtype=np.float32)
    depth = axial - (8.0 + 0.1 * lateral + 0.05 * bscan)
    tissue = 0.1 + 0.7 / (1.0 + np.exp(-3.0 * depth)) * np.exp(-np.maximum(depth, 0.0) / 30.0)
    noisy = tissue + 0.02 * generator.standard_normal(shape)
    return np.rint(np.clip(noisy, 0.0, 1.0) * 255).astype(np.uint8)


@pytest.fixture
def scan_file(tmp_path):
    path = tmp_path / "scan.nii.gz"
    save_volume(path, Volume.from_array(layered(), SPACING_M, intensity_scale="log"))
    return path


@pytest.fixture
def unstated_file(tmp_path):
    """The same scan in a file whose header does not state the unit of its spacing."""
    import nibabel

    path = tmp_path / "unstated.nii"
    nibabel.save(nibabel.Nifti1Image(layered(), np.eye(4)), path)
    return path


@pytest.fixture(scope="session")
def field_file(tmp_path_factory):
    """A field fitted to the scan, well enough to have its surface."""
    from octn_ros.cli import main

    folder = tmp_path_factory.mktemp("field")
    save_volume(folder / "scan.nii", Volume.from_array(layered(), SPACING_M))
    field = folder / "field.safetensors"
    assert main(["fit", str(folder / "scan.nii"), "-o", str(field), "--steps", "80", "--device", "cpu", "--json"]) == 0
    return field
