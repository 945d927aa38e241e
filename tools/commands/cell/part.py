"""weldcal part: the edges of a part as a table, as JSON and as a picture with their numbers."""

import io
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.systems.runner import Progress
from weldcal.tools.cli.options import RESULT, Call, Outcome, command, option
from weldcal.tools.commands.cell.new import OwnPart, planned
from weldcal.tools.commands.cell.screen import Seam, outside_hint, ranked, unit_hint
from weldcal.tools.report.render import csv_text, fixed, render, write_atomic

COLUMNS = ("id", "kind", "length_mm", "angle_deg", "radius_mm", "start", "end")
COLOURS = {"concave": "#c2281f", "flush": "#8a2be2", "convex": "#2b5fc4", "boundary": "#b37400"}
MOST_PLANNED = 10
MOST_DRAWN, MOST_NUMBERED = 20_000, 150  # triangles of a picture; edges in it with a number, as far as there is space
SHARES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)  # of an edge's length, where its number may be
DPI = 110
BEHIND_NUMBER = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8}
SHOWN = ("length_mm", "angle_deg", "gap_mm", "throat_mm")
VIEWS = ((32.0, -60.0), (32.0, 120.0))  # elevation, azimuth


@command("part", common=RESULT, short_help="List the edges of a part's file that can be welded.")
def part(
    call: Call,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A STEP, STL, OBJ or PLY file.", show_default=False)],
    units: Annotated[
        str | None, option("--units", "UNIT", "mm, m or inch.", show_default="the STEP file's own, mm for a mesh")
    ] = None,
    tool: Annotated[
        Path, option("--tool", "FILE", "Tool that has to fit the seams.", show_default="the shipped one")
    ] = WELDING,
    plan: Annotated[
        int,
        option(
            "--plan",
            "N",
            "Seams that the tool fits for which the arm's way is planned, the best first, for about a minute.",
        ),
    ] = MOST_PLANNED,
) -> Outcome:
    """List the seams and the edges of a part with their numbers, for workpiece.seams in a scenario, and draw them."""
    call.progress("find the seams", 0.0)
    shape = read_shape(file, units)
    call.progress("fit the tool", 0.2)
    seams = ranked(shape, load_tool(tool_file(tool)).tool)
    seams = with_plans(shape, seams, plan, file, units, tool_file(tool), call.progress)
    call.progress("draw", 0.9)
    folder = call.folder("part", file.name)
    write_part(shape, seams, folder)
    summary = {**as_json(shape, folder), "seams": [seam.as_row() for seam in seams]}
    return Outcome(summary, text=partial(emit_table, shape, seams, folder))


def with_plans(
    shape: PartShape, seams: list[Seam], most: int, file: Path, units: str | None, tool: Path, progress: Progress
) -> list[Seam]:
    """The seams with the verdict of the job's planner on the first that the tool fits, as `weldcal new` asks it."""
    asked = [seam for seam in seams if not seam.reason][:most]
    if not asked:
        return seams
    lines = [[shape.edge(id) for id in seam.joint.edges] for seam in asked]
    found = [
        replace(seam, reason=reason, pieces=pieces, planned=True)
        for seam, (reason, pieces) in zip(
            asked, planned(OwnPart(file, units=units), lines, tool, progress), strict=False
        )
    ]
    rest = [seam for seam in seams if seam not in asked[: len(found)]]
    return sorted([*found, *rest], key=lambda seam: bool(seam.reason))


def candidates(shape: PartShape) -> list[PartEdge]:
    """Return the edges that an operator may pick, the concave ones first; tangent edges are no joint."""
    order = {"concave": 0, "flush": 1, "boundary": 2, "convex": 3}
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
    """Return the whole part for JSON; every edge, tangent ones too."""
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


def emit_table(shape: PartShape, seams: list[Seam], folder: Path) -> None:
    """Print the candidate edges and the seams as tables."""
    size = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(shape.mesh.vertices, axis=0))
    typer.echo(f"{shape.name}: {size} mm, {shape.bodies} bodies, {len(shape.edges)} edges")
    typer.echo(f"{'id':>4}  {'kind':8}  {'length mm':>9}  {'angle deg':>9}  {'radius mm':>9}  start -> end, mm")
    for edge in candidates(shape):
        length, angle, radius = _figures(edge)
        ends = " -> ".join("({:.1f}, {:.1f}, {:.1f})".format(*(1e3 * p)) for p in (edge.points_P[0], edge.points_P[-1]))
        typer.echo(f"{edge.id:>4}  {edge.kind:8}  {length:>9}  {angle:>9}  {radius:>9}  {ends}")
    if seams:
        typer.echo(f"{'seam':16}  {'length mm':>9}  {'angle deg':>9}  {'throat mm':>9}  {'edges':16}  weldable")
    for seam in seams:
        row = seam.as_row()
        ids = ", ".join(map(str, seam.joint.edges))
        numbers = "  ".join(f"{row[key]:9.1f}" for key in ("length_mm", "angle_deg", "throat_mm"))
        typer.echo(f"{row['type']:16}  {numbers}  {ids:16}  {seam.verdict}")
    if not seams:
        typer.echo(
            "No seams are listed: no two bodies meet within 3 mm in a concave joint, and no body has a concave edge."
        )
    for hint in filter(None, (outside_hint(shape), unit_hint(shape))):
        typer.echo(hint)
    pick = "Pick by number in the scenario, workpiece.seams: [{edges: [ID, ...]}]. " if seams else ""
    typer.echo(f"{pick}Picture: {folder / 'report.html'}")


def _figures(edge: PartEdge) -> tuple[str, str, str]:
    angle = fixed(None if math.isnan(edge.angle_rad) else math.degrees(edge.angle_rad), 1)
    return fixed(1e3 * edge.length_m, 2), angle, fixed(None if edge.radius_m is None else 1e3 * edge.radius_m, 2)


def write_part(shape: PartShape, seams: list[Seam], folder: Path) -> None:
    """Write edges.png, edges.csv, report.html and seams.html."""
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
        "seams": [
            (row["type"], ", ".join(map(str, seam.joint.edges)), *(fixed(row[key], 1) for key in SHOWN), seam.verdict)
            for seam, row in ((seam, seam.as_row()) for seam in seams)
        ],
        "rows": [(str(e.id), e.kind, *_figures(e)) for e in chosen],
    }
    write_atomic(folder / "report.html", render("part.html.j2", page=page))
    write_atomic(folder / "seams.html", render("part_3d.html.j2", page={**page, "scene": _scene(shape, seams)}))


def _scene(shape: PartShape, seams: list[Seam]) -> dict[str, Any]:
    """Return the part's largest triangles and its seams for the 3D page, mm."""
    mesh = shape.mesh
    largest = np.argsort(-np.linalg.norm(mesh.area_vectors, axis=1), kind="stable")[: 4 * MOST_DRAWN]
    used, index = np.unique(mesh.triangles[largest], return_inverse=True)
    return {
        "vertices": (1e3 * mesh.vertices[used]).round(3).tolist(),
        "triangles": index.reshape(-1, 3).tolist(),
        "seams": [
            {
                "edges": list(seam.joint.edges),
                "lines": [(1e3 * shape.edge(id).points_P).round(2).tolist() for id in seam.joint.edges],
                "type": seam.as_row()["type"],
                "length": f"{1e3 * seam.joint.length_m:.1f}",
                "verdict": seam.verdict,
                "state": "no" if seam.reason else "yes" if seam.planned else "fits",
            }
            for seam in seams
        ],
    }


def edges_picture(shape: PartShape) -> bytes:
    """PNG of the part from two sides: its edges with their numbers, the concave ones in red."""
    figure = Figure(figsize=(15.0, 7.0), layout="constrained", dpi=DPI)
    drawn = []
    for k, (elevation, azimuth) in enumerate(VIEWS):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        assert isinstance(axes, Axes3D)
        axes.view_init(elev=elevation, azim=azimuth)
        _draw(axes, shape, _towards(elevation, azimuth))
        drawn.append(axes)
    figure.draw_without_rendering()  # the places of the axes are known only then
    figure.set_layout_engine("none")  # numbers do not move them
    for axes in drawn:
        _number(axes, shape)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    return stream.getvalue()


def _towards(elevation: float, azimuth: float) -> Array:
    """Unit vector (3,) from the part to the eye."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def _number(axes: Axes3D, shape: PartShape) -> None:
    """Write the edges' numbers, joints and long edges first, each where it covers no other; else not at all."""
    order = {"concave": 0, "flush": 0, "boundary": 1, "convex": 1}
    edges = sorted((e for e in shape.edges if e.kind in order), key=lambda e: (order[e.kind], -e.length_m))
    placed: list[Array] = []
    projection = axes.get_proj()
    for edge in edges[:MOST_NUMBERED]:
        size = 13.0 if order[edge.kind] == 0 else 8.0
        half = 0.5 * size * DPI / 72.0 * np.array([0.75 * len(str(edge.id)) + 0.4, 1.5])
        for share in SHARES:
            p = 1e3 * _along(edge.points_P, share)
            x, y, _ = proj3d.proj_transform(*p, projection)
            box = np.concatenate([axes.transData.transform((x, y)), half])
            if all((np.abs(box[:2] - other[:2]) > box[2:] + other[2:]).any() for other in placed):
                style = {"color": COLOURS[edge.kind], "fontsize": size, "fontweight": "bold", "zorder": 20}
                axes.text(*p, str(edge.id), bbox=BEHIND_NUMBER, ha="center", va="center", **style)
                placed.append(box)
                break


def _draw(axes: Axes3D, shape: PartShape, eye: Array) -> None:
    mesh = shape.mesh
    faces = _facing(mesh, eye)
    shade = 0.55 + 0.4 * np.clip(mesh.normals[faces] @ eye, 0.0, 1.0)
    colours = np.column_stack([shade * 0.93, shade * 0.95, shade, np.full(len(shade), 0.55)])
    axes.add_collection3d(
        Poly3DCollection(1e3 * mesh.vertices[mesh.triangles[faces]], facecolors=colours, edgecolors="none")
    )
    for kind, colour in COLOURS.items():
        wide = kind in ("concave", "flush")
        if not any(edge.kind == kind for edge in shape.edges):
            continue
        lines = [1e3 * edge.points_P for edge in shape.edges if edge.kind == kind]
        axes.add_collection3d(
            Line3DCollection(lines, colors=colour, linewidths=2.6 if wide else 0.8, zorder=5 if wide else 3)
        )
    low, high = 1e3 * mesh.bounds
    limits = {f"{k}lim": (low[i], high[i]) for i, k in enumerate("xyz")}
    axes.set(**limits, **{f"{k}label": f"{k}, mm" for k in "xyz"})
    axes.set_box_aspect(tuple(np.maximum(high - low, 0.05 * float((high - low).max()))))


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
