"""What a ROS parameter file says to one node, for a launch file that must know it before the node runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from octn_ros.embedded.arguments import Arguments, load
from octn_ros.errors import ConfigurationError
from octn_ros.nodes.simulator_config import SimulatorConfig
from octn_ros.simulation import PhantomConfig
from octn_ros.volume import VolumeGeometry, describe_scan


def read_parameters(path: str | Path, node: str) -> dict[str, Any]:
    """Return the parameters that a file gives to a node, by their dotted names; of those given twice the last.

    Args:
        path: a ROS parameter file (YAML); names of nodes may hold the wildcards `*` and `**`.
        node: full name of the node, such as `/octn/simulator`.

    Raises:
        ConfigurationError: the file cannot be read, or is no parameter file.
    """
    try:
        tree = load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{path}: expected a ROS parameter file (YAML): {error}") from error
    if not isinstance(tree, Mapping):
        raise ConfigurationError(f"{path}: expected names of nodes with ros__parameters, got {type(tree).__name__}")
    given = Arguments()
    given.add_tree(tree)
    return given.overrides(node)


def simulated_scan(parameters: Mapping[str, Any], volume: str, spacing_um: tuple[float, ...]) -> VolumeGeometry:
    """Return the grid of the C-scans that the simulator will send.

    Args:
        parameters: what is given to it, as from `read_parameters`.
        volume: file that it plays in place of its parameter `volume_file`; empty = that parameter.
        spacing_um: (bscan, axial, lateral) in place of its parameter `spacing_um`; empty = that parameter.

    Raises:
        VolumeError: the file cannot be read.
    """
    simulator, phantom = SimulatorConfig(), PhantomConfig()
    played = volume or parameters.get("volume_file", simulator.volume_file)
    if played:
        given_um = spacing_um or tuple(parameters.get("spacing_um", simulator.spacing_um))
        geometry = describe_scan(played, (given_um[0], given_um[1], given_um[2]) if all(given_um) else None).geometry
        shape, spacing_m = geometry.shape, geometry.spacing_m
    else:
        shape = tuple(parameters.get("phantom.shape", phantom.shape))
        spacing_m = tuple(parameters.get("phantom.spacing_m", phantom.spacing_m))
    factor = parameters.get("bscan_factor", simulator.bscan_factor)
    return VolumeGeometry(
        (-(-shape[0] // factor), shape[1], shape[2]), (spacing_m[0] * factor, spacing_m[1], spacing_m[2])
    )
