"""weldcal part: the edges of a part as a table, as JSON and as a picture with their numbers."""

import io
import math
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.tools.cli.options import RESULT, Call, Outcome, command, option
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import fixed, render, write_atomic

COLUMNS = ("id", "kind", "length_mm", "angle_deg", "radius_mm", "start", "end")
COLOURS = {"concave": "#c2281f", "convex": "#2b5fc4", "boundary": "#b37400"}
MOST_DRAWN = 20_000  # triangles of a picture
MOST_NUMBERED = 60  # convex edges with a number in the picture
VIEWS = ((32.0, -60.0), (32.0, 120.0))  # elevation, azimuth


@command("part", common=RESULT, short_help="List the edges of a part's file that can be welded.")
def part(
    call: Call,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A STEP, STL, OBJ or PLY file.", show_default=False)],
    units: Annotated[
        str | None, option("--units", "UNIT", "mm, m or inch.", show_default="the STEP file's own, mm for a mesh")
    ] = None,
) -> Outcome:
    """List the edges of a part with their numbers, for workpiece.seams in a scenario, and draw them."""
    shape = read_shape(file, units)
    folder = call.folder("part", file.name)
    write_part(shape, folder)
    return Outcome(as_json(shape, folder), text=partial(emit_table, shape, folder))


def candidates(shape: PartShape) -> list[PartEdge]:
    """The edges that a person may pick, the concave ones first; tangent edges are no joint."""
    order = {"concave": 0, "boundary": 1, "convex": 2}
    return sorted((e for e in shape.edges if e.kind in order), key=lambda e: (order[e.kind], e.id))


def as_row(edge: PartEdge) -> dict[str, object]:
    """One edge for JSON: millimetres and degrees, start and end in the part's frame."""
    return {
        "id": edge.id,
        "kind": edge.kind,
        "length_mm": 1e3 * edge.length_m,
        "angle_deg": None if math.isnan(edge.angle_rad) else math.degrees(edge.angle_rad),
        "radius_mm": None if edge.radius_m is None else 1e3 * edge.radius_m,
        "start": [float(v) for v in 1e3 * edge.points_P[0]],
        "end": [float(v) for v in 1e3 * edge.points_P[-1]],
    }


def as_json(shape: PartShape, folder: Path) -> dict[str, object]:
    """The whole part for JSON; every edge, tangent ones too."""
    return {
        "state": "done",
        "file": shape.name,
        "unit": {1e-3: "mm", 1.0: "m"}.get(shape.unit_m, "inch"),
        "bodies": shape.bodies,
        "size_mm": [float(v) for v in 1e3 * np.ptp(shape.mesh.vertices, axis=0)],
        "edges": [as_row(edge) for edge in shape.edges],
        "report": str(folder / "report.html"),
        "picture": str(folder / "edges.png"),
    }


def emit_table(shape: PartShape, folder: Path) -> None:
    """Print the candidate edges as a table."""
    size = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(shape.mesh.vertices, axis=0))
    typer.echo(f"{shape.name}: {size} mm, {shape.bodies} bodies, {len(shape.edges)} edges")
    typer.echo(f"{'id':>4}  {'kind':8}  {'length mm':>9}  {'angle deg':>9}  {'radius mm':>9}  start -> end, mm")
    for edge in candidates(shape):
        length, angle, radius = _figures(edge)
        ends = " -> ".join("({:.1f}, {:.1f}, {:.1f})".format(*(1e3 * p)) for p in (edge.points_P[0], edge.points_P[-1]))
        typer.echo(f"{edge.id:>4}  {edge.kind:8}  {length:>9}  {angle:>9}  {radius:>9}  {ends}")
    typer.echo(
        f"Pick by number in the scenario, workpiece.seams: [{{edges: [ID, ...]}}]. Picture: {folder / 'report.html'}"
    )


def _figures(edge: PartEdge) -> tuple[str, str, str]:
    angle = fixed(None if math.isnan(edge.angle_rad) else math.degrees(edge.angle_rad), 1)
    return fixed(1e3 * edge.length_m, 2), angle, fixed(None if edge.radius_m is None else 1e3 * edge.radius_m, 2)


def write_part(shape: PartShape, folder: Path) -> None:
    """Write edges.png, edges.csv and report.html."""
    picture = edges_picture(shape)
    rows = [as_row(edge) for edge in shape.edges]
    table = [
        [" ".join(f"{v:.4f}" for v in cell) if isinstance(cell, list) else cell for cell in row.values()]
        for row in rows
    ]
    write_atomic(folder / "edges.png", picture)
    write_atomic(folder / "edges.csv", csv_text(COLUMNS, table))
    chosen = candidates(shape)
    concave = [edge for edge in chosen if edge.kind == "concave"]
    size = " × ".join(f"{1e3 * v:.1f}" for v in np.ptp(shape.mesh.vertices, axis=0))
    page = {
        "title": shape.name,
        "size": size,
        "bodies": str(shape.bodies),
        "concave": str(len(concave)),
        "convex": str(len(chosen) - len(concave)),
        "picture": picture,
        "rows": [(str(e.id), e.kind, *_figures(e)) for e in chosen],
    }
    write_atomic(folder / "report.html", render("part.html.j2", page=page))


def edges_picture(shape: PartShape) -> bytes:
    """PNG of the part from two sides: its edges with their numbers, the concave ones in red."""
    figure = Figure(figsize=(15.0, 7.0), layout="constrained")
    numbered = {e.id for e in shape.edges if e.kind == "concave"}
    convex = sorted((e for e in shape.edges if e.kind in ("convex", "boundary")), key=lambda e: -e.length_m)
    numbered |= {e.id for e in convex[:MOST_NUMBERED]}
    for k, (elevation, azimuth) in enumerate(VIEWS):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        assert isinstance(axes, Axes3D)
        axes.view_init(elev=elevation, azim=azimuth)
        _draw(axes, shape, numbered, _towards(elevation, azimuth))
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()


def _towards(elevation: float, azimuth: float) -> Array:
    """Unit vector (3,) from the part to the eye."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def _draw(axes: Axes3D, shape: PartShape, numbered: set[int], eye: Array) -> None:
    mesh = shape.mesh
    faces = _facing(mesh, eye)
    shade = 0.55 + 0.4 * np.clip(mesh.normals[faces] @ eye, 0.0, 1.0)
    colours = np.column_stack([shade * 0.93, shade * 0.95, shade, np.full(len(shade), 0.55)])
    axes.add_collection3d(
        Poly3DCollection(1e3 * mesh.vertices[mesh.triangles[faces]], facecolors=colours, edgecolors="none")
    )
    for edge in shape.edges:
        if edge.kind == "smooth":
            continue
        colour, wide = COLOURS[edge.kind], edge.kind == "concave"
        x, y, z = 1e3 * edge.points_P.T
        axes.plot(x, y, z, color=colour, linewidth=2.6 if wide else 0.8, zorder=5 if wide else 3)
        if edge.id in numbered:
            # Off the middle by a share that differs from edge to edge, so that parallel edges' numbers stay apart.
            share = 0.35 + 0.3 * ((edge.id * 0.618) % 1.0)
            px, py, pz = 1e3 * _along(edge.points_P, share)
            size = 13.0 if wide else 8.0
            box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8}
            axes.text(px, py, pz, str(edge.id), color=colour, fontsize=size, fontweight="bold", zorder=20, bbox=box)
    low, high = 1e3 * mesh.bounds
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(np.maximum(high - low, 0.05 * float((high - low).max()))))
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_zlabel("z, mm")


def _facing(mesh: TriMesh, eye: Array) -> NDArray[np.int64]:
    """Indices of the triangles that face the eye, thinned to what a picture can hold."""
    facing = np.flatnonzero(mesh.normals @ eye > 0.0)
    if len(facing) <= MOST_DRAWN:
        return facing
    area = np.linalg.norm(mesh.area_vectors[facing], axis=1)
    return np.asarray(facing[np.argsort(-area)[:MOST_DRAWN]])


def _along(points: Array, share: float) -> Array:
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.array([np.interp(share * s[-1], s, points[:, k]) for k in range(3)])
