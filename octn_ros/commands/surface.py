"""`octn surface`: the tissue surface of a field, as a map of A-scans (eq. 3) or as the mesh f = tau (eq. 7)."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octn_ros.commands import arguments as common
from octn_ros.commands import terminal
from octn_ros.commands.regions import add_regions, region_of
from octn_ros.commands.sources import FieldSource, add_source, source_of

if TYPE_CHECKING:
    from octn_ros.field import Field
    from octn_ros.query import Region, SurfaceMap

MAP_SUFFIXES, MESH_SUFFIXES = (".ply", ".csv", ".npz"), (".ply", ".stl", ".npz")
Progress = Callable[[float], None]


@dataclass(frozen=True)
class SurfaceCommand:
    """Find the surface of a field.

    Attributes:
        source: a field or C-scan file, and how to open it.
        output: the file of the map's points (.ply, .csv, .npz) or of the mesh (.ply, .stl, .npz).
        tau: intensity of the surface; None to estimate it from the map.
        mesh: find the mesh f = tau instead of the map.
        region: only the surface inside it, None for the whole scan; of a map, inside the rectangle around it.
        within_um: only the mesh this close to the map, along the beam; infinity for all of f = tau, speckle too.
        step_um: distance of the mesh's lattice points, None for the scan's own voxels.
        ascans: largest number of A-scans of the map, None for the default.
        distance: an .npz file for the signed distance to the mesh, or None.
        picture: a .png file for depth and confidence of the map, or None.
        json: print JSON instead of a table.
    """

    source: FieldSource
    output: Path
    tau: float | None = None
    mesh: bool = False
    region: Region | None = None
    within_um: float = 100.0
    step_um: float | None = None
    ascans: int | None = None
    distance: Path | None = None
    picture: Path | None = None
    json: bool = False

    def run(self) -> int:
        """Find the surface, write it, print what it is like; return 0.

        Raises:
            OctnError: an argument or a file cannot be used, or there is no surface.
        """
        suffixes = MESH_SUFFIXES if self.mesh else MAP_SUFFIXES
        if self.output.suffix not in suffixes:
            what = "a mesh" if self.mesh else "a map's points"
            raise terminal.CommandError(f"{self.output}: expected {what} to write as {', '.join(suffixes)}")
        if not self.mesh and (self.step_um is not None or self.distance is not None):
            raise terminal.CommandError("expected --step-um and --distance with --mesh only, got them for a map")
        for path in filter(None, (self.output, self.picture, self.distance)):
            terminal.check_output_file(path)
        field = self.source.open()
        began = time.perf_counter()
        surface = self._map(field)
        values = _describe(surface, self.tau) | {"surface_s": time.perf_counter() - began, "field": field.kind}
        if self.mesh:
            with terminal.ProgressBar() as bar:
                values |= self._write_mesh(field, surface, values["tau"], lambda share: bar.show("meshing", share))
        else:
            _write_map(self.output, surface, field)
        if self.picture is not None:
            from octn_ros.commands.query_pictures import surface_picture

            terminal.write_bytes(self.picture, surface_picture(surface))
        values |= {"file": str(self.output), "picture": None if self.picture is None else str(self.picture)}
        if self.json:
            terminal.print_json(values)
        else:
            terminal.print_table(f"{self.source.file.name}: surface", _rows(values))
        return 0

    def _map(self, field: Field) -> SurfaceMap:
        from octn_ros.query import SurfaceMapConfig, surface_map

        config = SurfaceMapConfig() if self.ascans is None else SurfaceMapConfig(max_ascans=self.ascans)
        if self.region is None:
            return surface_map(field, config)
        (x0, y0, _), (x1, y1, _) = self.region.bounds_m()
        return surface_map(field, config, lateral_range_m=(x0, x1), bscan_range_m=(y0, y1))

    def _write_mesh(self, field: Field, surface: SurfaceMap, tau: float, progress: Progress) -> dict[str, Any]:
        import numpy as np

        from octn_ros.query import NearSurface, iso_surface, signed_distance, write_mesh

        region = self.region
        if self.within_um != math.inf:
            near = NearSurface(surface, self.within_um * 1e-6, self.within_um * 1e-6)
            region = near if region is None else near & region
        step_m = None if self.step_um is None else self.step_um * 1e-6
        if self.distance is None:
            mesh = iso_surface(field, tau, region, step_m, progress=progress)
        else:
            found = signed_distance(field, tau, region, step_m, progress=progress)
            mesh = found.mesh
            with terminal.writing(self.distance), self.distance.open("wb") as file:
                np.savez_compressed(file, distance_m=found.distance_m, x_m=found.x_m, y_m=found.y_m, z_m=found.z_m)
        write_mesh(self.output, mesh)
        return {
            "vertices": len(mesh.vertices_m),
            "triangles": len(mesh.faces),
            "area_mm2": mesh.area_m2 * 1e6,
            "distance": None if self.distance is None else str(self.distance),
        }


def _write_map(path: Path, surface: SurfaceMap, field: Field) -> None:
    import numpy as np

    from octn_ros.query import write_points

    y, x = np.meshgrid(surface.bscan_m, surface.lateral_m, indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), surface.depth_m.ravel()])
    values = {"intensity": surface.intensity.ravel(), "confidence": surface.confidence.ravel()}
    write_points(path, points, values, field.description)


def add_parser(commands: Any) -> None:
    """Add the command to the parser's subcommands."""
    parser = commands.add_parser("surface", help="find the tissue surface of a field", description=__doc__)
    add_source(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=f"the points of the map ({', '.join(MAP_SUFFIXES)}) or the mesh ({', '.join(MESH_SUFFIXES)}) to write",
    )
    parser.add_argument("--mesh", action="store_true", help="the mesh f = tau instead of the map")
    parser.add_argument("--tau", type=float, metavar="T", help="intensity of the surface; default: the map's median")
    add_regions(parser)
    parser.add_argument("--ascans", type=int, metavar="N", help="largest number of A-scans of the map")
    parser.add_argument(
        "--within-um",
        type=float,
        default=100.0,
        metavar="W",
        help="only the mesh this close to the map, default 100; inf for all of f = tau",
    )
    parser.add_argument("--step-um", type=float, metavar="S", help="distance of the mesh's lattice points")
    parser.add_argument("--distance", type=Path, metavar="FILE", help="write signed distances to the mesh, .npz")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw depth and confidence into this .png")
    common.add_json(parser)
    parser.set_defaults(read=_read)


def _read(arguments: argparse.Namespace) -> SurfaceCommand:
    return SurfaceCommand(
        source=source_of(arguments),
        output=arguments.output,
        tau=arguments.tau,
        mesh=arguments.mesh,
        region=region_of(arguments),
        within_um=arguments.within_um,
        step_um=arguments.step_um,
        ascans=arguments.ascans,
        distance=arguments.distance,
        picture=arguments.picture,
        json=arguments.json,
    )


def _describe(surface: SurfaceMap, tau: float | None) -> dict[str, Any]:
    import numpy as np

    from octn_ros.query import surface_intensity

    low, middle, high = np.quantile(surface.depth_m, (0.01, 0.5, 0.99)) * 1e3
    tenth, half = np.quantile(surface.confidence, (0.1, 0.5))
    return {
        "ascans": int(surface.depth_m.size),
        "tau": surface_intensity(surface) if tau is None else tau,
        "tau_from": "map" if tau is None else "arguments",
        "depth_mm": {"p1": float(low), "median": float(middle), "p99": float(high)},
        "confidence": {"p10": float(tenth), "median": float(half)},
    }


def _rows(values: dict[str, Any]) -> list[tuple[str, str]]:
    depth, confidence = values["depth_mm"], values["confidence"]
    rows = [
        ("map", f"{values['ascans']} A-scans in {values['surface_s']:.2f} s"),
        ("tau", f"{values['tau']:.4f}, from the {values['tau_from']}"),
        ("depth", f"median {depth['median']:.4f} mm, 98 % between {depth['p1']:.4f} and {depth['p99']:.4f} mm"),
        ("confidence", f"median {confidence['median']:.2f}, a tenth below {confidence['p10']:.2f}"),
    ]
    if "triangles" in values:
        rows.append(("mesh", f"{values['triangles']:,} triangles, {values['area_mm2']:.3f} mm^2"))
    names = ("distance", "picture", "file")
    return rows + [(name, values[name]) for name in names if values.get(name)]
