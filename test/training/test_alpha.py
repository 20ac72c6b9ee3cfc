"""What interpolated samples are for: the paper's ablation (its table 4), where the fit learns the speckle itself."""

import numpy as np
import pytest
import torch

from octn_ros.field import HashGridConfig, NetworkConfig, NeuralFieldConfig
from octn_ros.metrics import psnr_db
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.training import FitConfig, fit

SHAPE = (16, 32, 32)


def grid_and_fraction_psnr(volume, alpha):
    """Return the PSNR on the voxels, and on the B-scan at D/2 + 0.5 against trilinear interpolation of the volume."""
    config = FitConfig(
        preset="test",
        field=NeuralFieldConfig(
            HashGridConfig(levels=8, features=2, log2_table_size=12, base_resolution=8, finest_ratio=4.0),
            NetworkConfig(2, 32),
        ),
        steps=300,
        batch=2048,
        alpha=alpha,
    )
    field = fit(volume, config).field
    bscan, axial, lateral = (torch.linspace(-1, 1, n) for n in SHAPE)
    voxels, middle = volume.normalized(), SHAPE[0] // 2
    between = torch.tensor([2 * (middle + 0.5) / (SHAPE[0] - 1) - 1])
    proxy = 0.5 * (voxels[middle] + voxels[middle + 1])
    return (
        psnr_db(voxels, field.lattice(lateral, axial, bscan).numpy()),
        psnr_db(proxy, field.lattice(lateral, axial, between)[0].numpy()),
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_fifth_of_interpolated_samples_cures_what_lies_between_the_bscans():
    volume = make_phantom(PhantomConfig(shape=SHAPE)).volume
    grid, fraction = np.array([grid_and_fraction_psnr(volume, alpha) for alpha in (0.0, 0.2)]).T
    assert fraction[1] > fraction[0] + 2.0
    assert grid[1] > grid[0] - 1.0
