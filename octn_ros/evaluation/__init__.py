"""The package measured against the paper: how faithful a field is, and one module per table or figure."""

from octn_ros.evaluation.fidelity import Fidelity, RegionFidelity, assess_field, fractional_psnr_db
from octn_ros.evaluation.grid_comparison import SURFACE_VARIANTS, GridComparison, compare_on_grid

__all__ = [
    "SURFACE_VARIANTS",
    "Fidelity",
    "GridComparison",
    "RegionFidelity",
    "assess_field",
    "compare_on_grid",
    "fractional_psnr_db",
]
