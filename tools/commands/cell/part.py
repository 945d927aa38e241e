"""weldcal part: the edges of a part as a table, as JSON and as a picture with their numbers."""

import io
import math
from dataclasses import dataclass, replace
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
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh, extrude, merge
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.reading import STEP_SUFFIXES, read_shape
from weldcal.models.workpieces.seat import JointSection, check_weldable, hard_height
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartJoint, PartShape
from weldcal.systems.runner import Progress
from weldcal.tools.cli.options import RESULT, Call, Outcome, command, option
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import fixed, render, write_atomic
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.room import NoRoom, check_room

COLUMNS = ("id", "kind", "length_mm", "angle_deg", "radius_mm", "start", "end")
COLOURS = {"concave": "#c2281f", "flush": "#8a2be2", "convex": "#2b5fc4", "boundary": "#b37400"}
MOST_PLANNED = 10
MOST_DRAWN, MOST_NUMBERED = 20_000, 150  # triangles of a picture; edges in it with a number, as far as there is space
SHARES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)  # of an edge's length, where its number may be
DPI = 110
SMALL_M = 0.012  # a part this small may be drawn in inches
PIPES_M, PIPE_STEP_M = (0.005, 0.5), 5e-4  # radii among which the least one for a tool is searched
SHOWN = ("length_mm", "angle_deg", "gap_mm", "throat_mm")
NO_SEAMS = {
    True: "no two bodies meet within 3 mm in a concave joint, and no body has a concave edge.",
    False: "the file is a mesh. Choose a concave edge, or the edge of a body where it meets another.",
}
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
        int, option("--plan", "N", "Seams that the tool fits for which the arm's way is planned, the best first.")
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


@dataclass(frozen=True)
class Seam:
    """A joint of a part, its smallest radius in m (None where it is straight), and why a tool cannot weld it ("": it can).

    short_m: by how much the tool's clearance is too small; infinite where the joint itself is none for its ball.
    planned: whether a new cell's arm was asked, too.
    """

    joint: PartJoint
    radius_m: float | None
    reason: str
    short_m: float = 0.0
    planned: bool = False

    @property
    def verdict(self) -> str:
        """Whether it can be welded, for a table."""
        return f"no: {self.reason}" if self.reason else "yes" if self.planned else "fits the tool, not planned"

    def as_row(self) -> dict[str, Any]:
        """The seam for JSON: millimetres and degrees."""
        j = self.joint
        return {
            "type": f"{j.type} {j.side}".strip(),
            "edges": list(j.edges),
            "length_mm": 1e3 * j.length_m,
            "angle_deg": math.degrees(j.angle_rad),
            "gap_mm": 1e3 * j.gap_m,
            "least_radius_mm": None if self.radius_m is None else 1e3 * self.radius_m,
            "throat_mm": 1e3 * min(j.walls_m) * math.cos(0.5 * j.angle_rad),
            "closed": j.closed,
            "weldable": not self.reason,
            "reason": self.reason,
            "planned": self.planned,
        }


def ranked(shape: PartShape, tool: WeldingTool) -> list[Seam]:
    """The joints of a part: those that the tool can weld first, the longest first, then the others, the nearest miss first.

    The arm is not asked.
    """
    found = []
    for joint in shape.joints:
        radii = [r for id in joint.edges if (r := shape.edge(id).radius_m) is not None]
        found.append(Seam(joint, min(radii, default=None), *_obstacle(shape, joint, tool)))
    return sorted(found, key=lambda seam: (bool(seam.reason), seam.short_m, -seam.joint.length_m))


def with_plans(
    shape: PartShape, seams: list[Seam], most: int, file: Path, units: str | None, tool: Path, progress: Progress
) -> list[Seam]:
    """The seams with the verdict of the job's planner on the first that the tool fits, as `weldcal new` asks it."""
    from weldcal.tools.commands.cell.new import OwnPart, pieces, planned

    asked = [seam for seam in seams if not seam.reason][:most]
    if not asked:
        return seams
    lines = [pieces([shape.edge(id) for id in seam.joint.edges])[0] for seam in asked]
    reasons = planned(OwnPart(file, units=units), lines, tool, progress)
    found = [replace(seam, reason=reason, planned=True) for seam, reason in zip(asked, reasons, strict=True)]
    return sorted([*found, *(seam for seam in seams if seam not in asked)], key=lambda seam: bool(seam.reason))


def _obstacle(shape: PartShape, joint: PartJoint, tool: WeldingTool) -> tuple[str, float]:
    """Why a tool does not fit a joint, its ball at the walls or its body at the middle of one of the edges, and by how much, m."""
    flush = joint.angle_rad > math.pi - 0.01
    half, gap = (0.5 * math.pi, joint.gap_m) if flush else (0.5 * joint.angle_rad, 0.0)
    section = JointSection(half, *joint.walls_m, gap)
    ring = _ring(shape, joint)
    try:
        check_weldable(section, tool.tip_radius_m)
        if ring is not None:
            _check_ring(shape.mesh, *ring, hard_height(section, tool.tip_radius_m), tool)
        for id in joint.edges if ring is None else ():
            edge = shape.edge(id)
            assert edge.up_P is not None
            k = max(1, len(edge.points_P) // 2)
            along = edge.points_P[k] - edge.points_P[k - 1]
            middle = edge.points_P[k] if len(edge.points_P) > 2 else edge.points_P.mean(axis=0)
            tip = middle + hard_height(section, tool.tip_radius_m) * edge.up_P
            line = tip + np.linspace(-2e-3, 2e-3, 5)[:, None] * along / np.linalg.norm(along)
            seam = SeamCurve.from_points(line, up=np.tile(edge.up_P, (5, 1)))
            check_room(shape.mesh, RigidTransform(), seam, tool.capsules(), tool.X_FT, 0.0)
    except WeldcalError as error:
        reason = str(error).replace(" at 0 mm of the seam", "").replace(" at 4 mm of the seam", "")
        if ring is not None and isinstance(error, NoRoom):
            reason += least_pipe(shape, joint, tool)
        return reason, error.short_m if isinstance(error, NoRoom) else math.inf
    return "", 0.0


def _ring(shape: PartShape, joint: PartJoint) -> tuple[Array, Array] | None:
    """Points (N,3) m of a joint that is one circle, and there the directions (N,3) out of it; None for any other."""
    edge = shape.edge(joint.edges[0])
    if edge.radius_m is None or not edge.closed or len(joint.edges) > 1 or edge.up_P is None:
        return None
    line = edge.points_P
    radial = (line - line[:-1].mean(axis=0)) / edge.radius_m
    axis = np.cross(radial[0], radial[len(line) // 4])
    axis /= np.linalg.norm(axis)
    return line, (edge.up_P @ axis) * axis + (edge.up_P @ radial[len(line) // 2]) * radial


def _check_ring(mesh: TriMesh, line: Array, up: Array, height_m: float, tool: WeldingTool) -> None:
    """Raise NoRoom where the tool does not fit all around a circle, its torch behind its tip."""
    seam = SeamCurve.from_points(line + height_m * up, up=up)
    check_room(mesh, RigidTransform(), seam, tool.capsules(), tool.X_FT, tool.chord_m)


def least_pipe(shape: PartShape, joint: PartJoint, tool: WeldingTool) -> str:
    """What the least pipe is whose outside the tool can weld onto a plate, both as far as the joint's longer wall; "" for a joint that is none of these."""
    ring = _ring(shape, joint)
    if ring is None or float(ring[1][0] @ (ring[0][0] - ring[0][:-1].mean(axis=0))) <= 0.0:
        return ""
    around = np.linspace(0.0, 2.0 * math.pi, 181)
    circle, far, (low, high) = np.stack([np.cos(around), np.sin(around)], axis=1), max(joint.walls_m), PIPES_M
    up = np.hstack([circle, np.ones((181, 1))]) / math.sqrt(2.0)
    while high - low > PIPE_STEP_M:
        radius = 0.5 * (low + high)
        plate = (radius + far) * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        mesh = merge(extrude(radius * circle[:-1], 0.0, far), extrude(plate, -0.01, 0.0))
        line = np.pad(radius * circle, ((0, 0), (0, 1)))
        try:
            _check_ring(mesh, line, up, math.sqrt(2.0) * tool.tip_radius_m, tool)
            high = radius
        except NoRoom:
            low = radius
    return f" The least pipe for this tool is {2e3 * high:.0f} mm across."


def unit_hint(shape: PartShape) -> str:
    """What a part so small that its file may be in inches asks; "" for any other."""
    size = np.ptp(shape.mesh.vertices, axis=0)
    if max(size) >= SMALL_M or shape.unit_m != UNITS_M["mm"]:
        return ""
    return "The part is only {:.1f} x {:.1f} x {:.1f} mm: its unit may be inch; check the file.".format(*(1e3 * size))


def candidates(shape: PartShape) -> list[PartEdge]:
    """The edges that a person may pick, the concave ones first; tangent edges are no joint."""
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
        typer.echo(f"No seams are listed: {NO_SEAMS[bool(shape.name.lower().endswith(STEP_SUFFIXES))]}")
    if hint := unit_hint(shape):
        typer.echo(hint)
    typer.echo(
        f"Pick by number in the scenario, workpiece.seams: [{{edges: [ID, ...]}}]. Picture: {folder / 'report.html'}"
    )


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
            (
                row["type"],
                ", ".join(map(str, seam.joint.edges)),
                *(fixed(row[key], 1) for key in SHOWN),
                seam.verdict,
            )
            for seam, row in ((seam, seam.as_row()) for seam in seams)
        ],
        "rows": [(str(e.id), e.kind, *_figures(e)) for e in chosen],
    }
    write_atomic(folder / "report.html", render("part.html.j2", page=page))
    write_atomic(folder / "seams.html", render("part_3d.html.j2", page={**page, "scene": _scene(shape, seams)}))


def _scene(shape: PartShape, seams: list[Seam]) -> dict[str, Any]:
    """The part's largest triangles and its seams for the 3D page, mm."""
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
    """Write the edges' numbers, those of joints and long edges first, each where it covers no other; else not at all."""
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
                style = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8}
                axes.text(
                    *p, str(edge.id), color=COLOURS[edge.kind], fontsize=size, fontweight="bold", zorder=20, bbox=style,
                    ha="center", va="center",
                )  # fmt: skip
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
