"""Phantoms with names: the tissues that planning is judged on, and the systems that scan them.

A name is a tissue, then what the scan of it is like, in any order: `wavy`, `wavy-13dB-single-look`,
`glare-8dB-averaged-grain1.2`, `flat+0.25-top-layer`. What is left out is as in `PhantomConfig`.
"""

from __future__ import annotations

import difflib
import re
from types import MappingProxyType
from typing import Any

from octn_ros.errors import ConfigurationError
from octn_ros.simulation.artefacts import ArtefactConfig
from octn_ros.simulation.phantom_config import PhantomConfig

_AXIAL_SPACING_M = 14.59e-6
_FLAT_VOXELS = 40  # depth of the flat ones; the shares of a voxel in their names come on top
_TOP_LAYER_DB = 8.0


def _flat(offset_voxels: float) -> dict[str, Any]:
    return {"surface": "flat", "surface_depth_m": (_FLAT_VOXELS + offset_voxels) * _AXIAL_SPACING_M}


def _tilted(tilt_deg: float, axials: int) -> dict[str, Any]:
    # 3.6 mm at this tilt need more axial range than the default shape has.
    return {"surface": "tilted", "tilt_deg": tilt_deg, "shape": (128, axials, 256)}


def _spoilt(**artefacts: Any) -> dict[str, Any]:
    return {"artefacts": ArtefactConfig(**artefacts)}


SMOOTH = MappingProxyType(
    {
        "flat": _flat(0.0),
        "flat+0.25": _flat(0.25),
        "flat+0.5": _flat(0.5),
        "flat+0.75": _flat(0.75),
        "tilted5": _tilted(5.0, 160),
        "tilted15": _tilted(15.0, 192),
        "tilted30": _tilted(30.0, 288),
        "wavy": {},
        "rough": {"surface": "rough"},
        "steep30": {"surface": "steep", "steepest_deg": 30.0},
        # More range than the default, so that the inclusion stays below the deepest fold.
        "steep45": {"surface": "steep", "steepest_deg": 45.0, "shape": (128, 192, 256)},
    }
)
"""Settings of the tissues on which every waypoint should be found, by name."""

ADVERSE = MappingProxyType(
    {
        "stepped": {"surface": "stepped"},
        "glare": _spoilt(glare_spots=6),
        "shadow": _spoilt(hairs=2),
        "detached-layer": _spoilt(detached_layer=True),
        "dye": _spoilt(dye_patches=4),
        "motion": _spoilt(axial_jitter_m=5e-6, lateral_jitter_m=7e-6, jump_m=60e-6),
    }
)
"""Settings of the tissues on which some places cannot be trusted, by name."""

NAMED_PHANTOMS = MappingProxyType({**SMOOTH, **ADVERSE})
"""Settings of every named tissue that differ from the defaults; `named_phantom` makes the configuration."""


def named_phantom(name: str, **overrides: Any) -> PhantomConfig:
    """Return the configuration of a named phantom.

    Args:
        name: a tissue of `NAMED_PHANTOMS`, then any of `-13dB` (or another number), `-single-look`, `-averaged`,
            `-grain1.2` (or another number) and `-top-layer`.
        overrides: settings of `PhantomConfig` that win over the name, `shape` for instance.

    Raises:
        ConfigurationError: no phantom has this name, or the settings do not fit together.
    """
    tissue = max((known for known in NAMED_PHANTOMS if f"{name}-".startswith(f"{known}-")), key=len, default="")
    if not tissue:
        near = difflib.get_close_matches(name, NAMED_PHANTOMS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ConfigurationError(f"phantom: expected a name of {', '.join(NAMED_PHANTOMS)}, got {name!r}{hint}")
    values = dict(NAMED_PHANTOMS[tissue])
    rest = name[len(tissue) :]
    while rest:
        for pattern, setting_of in _SYSTEM:
            match = pattern.match(rest)
            if match:
                values.update(setting_of(match))
                rest = rest[match.end() :]
                break
        else:
            raise ConfigurationError(
                f"phantom {name!r}: expected -NUMBERdB, -single-look, -averaged, -grainNUMBER or -top-layer after "
                f"{tissue!r}, got {rest!r}"
            )
    return PhantomConfig(**{**values, **overrides})


_NUMBER = r"(\d+(?:\.\d+)?)"
_SYSTEM = (
    (re.compile(rf"-{_NUMBER}dB(?=-|$)"), lambda match: {"snr_db": float(match[1])}),
    (re.compile(r"-(single-look|averaged)(?=-|$)"), lambda match: {"speckle": match[1]}),
    (re.compile(rf"-grain{_NUMBER}(?=-|$)"), lambda match: {"grain_voxels": float(match[1])}),
    (re.compile(r"-top-layer(?=-|$)"), lambda match: {"top_layer_db": _TOP_LAYER_DB}),
)
