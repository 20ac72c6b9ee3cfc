"""The artefacts of a phantom: which there are, where they lie, where they hide or fake the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from octn_ros.settings import check_settings, setting
from octn_ros.simulation.dye import Dye
from octn_ros.simulation.glare import Glare
from octn_ros.simulation.hair import Hair
from octn_ros.simulation.membrane import Membrane
from octn_ros.simulation.optics import Light
from octn_ros.simulation.surface import TissueSurface


class Artefact(Protocol):
    """Something that changes the light of some A-scans; all places are in the tissue's own frame, metres."""

    def mask(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where it hides or fakes the surface, at broadcast `x_m` and `y_m`."""

    def apply(self, light: Light) -> None:
        """Change the light that comes back from a slab of B-scans in place."""


@dataclass(frozen=True)
class ArtefactConfig:
    """What spoils the scan of a phantom; none by default. Places follow from the phantom's tissue seed.

    Raises:
        ConfigurationError: a value is outside its range.
    """

    glare_spots: int = setting(0, "specular spots that saturate whole columns", low=0, high=50)
    hairs: int = setting(0, "hairs above the tissue that throw a shadow", low=0, high=20)
    detached_layer: bool = setting(False, "a bright fragment of membrane in the air above part of the tissue")
    dye_patches: int = setting(0, "patches of ink on the surface, bright and dark in turn", low=0, high=20)
    axial_jitter_m: float = setting(
        0.0, "standard deviation of the axial motion from B-scan to B-scan", unit="m", low=0.0, high=1e-3
    )
    lateral_jitter_m: float = setting(
        0.0, "standard deviation of the lateral motion from B-scan to B-scan", unit="m", low=0.0, high=1e-3
    )
    jump_m: float = setting(
        0.0, "from a B-scan in the middle third on, the tissue lies this much deeper", unit="m", low=-1e-3, high=1e-3
    )

    def __post_init__(self) -> None:
        check_settings(self)


def place_artefacts(
    config: ArtefactConfig,
    surface: TissueSurface,
    half_sides_m: tuple[float, float],
    white_over_air_db: float,
    seed: int,
) -> Sequence[Artefact]:
    """Return the artefacts in the order in which the light meets them from below; motion is not among them.

    Args:
        config: which ones.
        surface: the interface in the tissue's own frame.
        half_sides_m: half the scan's lateral and bscan extent, metres, within which they are placed.
        white_over_air_db: mean power of air below the display's white, dB.
        seed: seed of their places.
    """
    centre = surface.centre_m
    placed: list[Artefact] = [*Dye.placed(config.dye_patches, centre, half_sides_m, seed)]
    if config.detached_layer:
        placed.append(Membrane.placed(centre, half_sides_m, seed))
    placed += Hair.placed(config.hairs, centre, half_sides_m, seed)
    if config.glare_spots:
        placed.append(Glare.placed(config.glare_spots, surface, half_sides_m, white_over_air_db, seed))
    return placed
