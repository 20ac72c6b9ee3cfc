"""What the demo scans: the phantom, whose truth is known, or a recorded C-scan."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octn_ros.metrics.surface import SurfaceDepth
from octn_ros.simulation import PhantomConfig, make_phantom
from octn_ros.volume import Volume, load_volume


@dataclass(frozen=True)
class ScanSource:
    """The measured volume, what is known beyond it, and the simulator's parameters that make it scan the same.

    Attributes:
        name: in words.
        volume: what the scanner measures.
        truth: the same without noise, None for a recording.
        surface_depth_m: depth of the true surface at x, y in the OCT frame, None for a recording.
        simulator_parameters: parameters of the simulator node.
        description: what identifies the source, as JSON can hold it.
    """

    name: str
    volume: Volume
    truth: Volume | None
    surface_depth_m: SurfaceDepth | None
    simulator_parameters: dict[str, Any]
    description: dict[str, Any]

    @property
    def trainer_parameters(self) -> dict[str, Any]:
        """Parameters of a trainer that is told what the B-scans do not say, and keeps no field."""
        geometry = self.volume.geometry
        return {
            "bscan_count": geometry.shape[0],
            "spacing_um": [s * 1e6 for s in geometry.spacing_m],
            "intensity_scale": self.volume.intensity_scale,
            "field_path": "",
        }


def phantom_source(config: PhantomConfig) -> ScanSource:
    """Make the phantom that the simulator makes from the same seed and configuration."""
    phantom = make_phantom(config)
    values = dataclasses.asdict(config)
    return ScanSource(
        name=f"phantom {config.name}, {_extent(phantom.volume)}",
        volume=phantom.volume,
        truth=phantom.truth,
        surface_depth_m=phantom.surface_depth_m,
        simulator_parameters=_dotted("phantom", values),
        description=values,
    )


def recorded_source(path: Path, spacing_um: tuple[float, float, float] | None) -> ScanSource:
    """Read a recorded C-scan.

    Raises:
        VolumeError: the file cannot be used.
    """
    volume = load_volume(path, spacing_um)
    parameters: dict[str, Any] = {"volume_file": str(path.resolve())}
    if spacing_um is not None:
        parameters["spacing_um"] = spacing_um
    return ScanSource(
        name=f"{path.name}, {_extent(volume)}",
        volume=volume,
        truth=None,
        surface_depth_m=None,
        simulator_parameters=parameters,
        description={"file": str(path), **volume.geometry.to_plain(), "intensity_scale": volume.intensity_scale},
    )


def _dotted(prefix: str, values: dict[str, Any]) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    for name, value in values.items():
        name = f"{prefix}.{name}"
        parameters.update(_dotted(name, value) if isinstance(value, dict) else {name: value})
    return parameters


def _extent(volume: Volume) -> str:
    width, length, depth = (side * 1e3 for side in volume.geometry.extent_m)
    shape = " x ".join(str(n) for n in volume.geometry.shape)
    return f"{shape} voxels, {width:.2f} mm lateral, {length:.2f} mm bscan, {depth:.2f} mm axial"
