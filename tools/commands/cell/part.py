"""weldcal part: which seams of a part can be welded, as a table, as JSON and as a page in 3D."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.tools.cli.options import MOST_LINES, RESULT, Call, Outcome, command, option
from weldcal.tools.commands.cell.screen import (
    Offer,
    Seam,
    alike,
    by_reason,
    edges_text,
    outside_hint,
    ranked,
    side_of,
    unit_hint,
    used_s,
)
from weldcal.tools.console import Progress, emit_summary
from weldcal.tools.report.first_screen import typed
from weldcal.tools.report.render import csv_text, fixed, render, write_atomic

COLUMNS = ("id", "kind", "length_mm", "angle_deg", "radius_mm", "start", "end")
MOST_PLANNED = 10
MOST_DRAWN = 80_000  # triangles of the page: a choice, fine for a browser without a graphics card
PAGE = "seams.html"


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
    """List the seams of a part that a new cell's arm can weld, with the numbers of their edges, and show them in 3D."""
    began_s = used_s()
    call.progress("find the seams", 0.0)
    shape = read_shape(file, units)
    call.progress("fit the tool", 0.2)
    seams = ranked(shape, load_tool(tool_file(tool)).tool)
    call.progress(first_list(seams), 0.3)
    seams = with_plans(shape, seams, plan, file, units, tool_file(tool), call.progress, began_s)
    call.progress("draw", 0.9)
    folder = call.folder("part", file.name)
    more = [] if tool == WELDING else ["--tool-file", shlex.quote(str(tool))]
    more += [] if units is None else ["--units", units]

    def make(edges: Sequence[int]) -> str:
        return typed("new my_cell --part", file, "--edges", ",".join(map(str, edges)), *more)

    write_part(shape, seams, folder, make)
    groups = alike(seams)
    first_like = {k: group[0] + 1 for group in groups for k in group}
    rows = [{**seam.as_row(), "like": first_like[k]} for k, seam in enumerate(seams)]
    summary = {**as_json(shape, folder), "seams": rows}
    first = next((tuple(offer.edges) for seam in seams for offer in seam.offers), None)
    if first is None and plan > 0:  # no time was left to ask the arm
        first = next((seam.joint.edges for seam in seams if not seam.reason and not seam.planned), None)
    following = "" if first is None else make(first)
    shown = partial(emit_table, shape, seams, folder, following, file, call.verbose)
    return Outcome({**summary, "next": following}, text=shown)


def first_list(seams: list[Seam]) -> str:
    """Say which seams the tool fits, one line each, before the arm is asked."""
    fit = [seam for seam in seams if not seam.reason]
    lines = [
        f"{edges_text(seam.joint.edges)}: {seam.as_row()['type']}, {1e3 * seam.joint.length_m:.1f} mm" for seam in fit
    ]
    more = [f"and {len(fit) - MOST_PLANNED} more"] * (len(fit) > MOST_PLANNED)
    return "\n".join([f"the tool fits {len(fit)} of {len(seams)} seams", *lines[:MOST_PLANNED], *more])


def with_plans(
    shape: PartShape,
    seams: list[Seam],
    most: int,
    file: Path,
    units: str | None,
    tool: Path,
    progress: Progress,
    began_s: float | None = None,
) -> list[Seam]:
    """The seams with what a new cell's arm can weld of the first of them, as `weldcal new` asks it; see `planned`."""
    asked = seams[:most]
    if not asked:
        return seams
    from weldcal.tools.commands.cell.new import OwnPart, planned  # only here: the list comes before these imports

    answers = planned(OwnPart(file, units=units), [seam.joint.edges for seam in asked], tool, progress, began_s)
    found = []
    for seam, (offers, refused) in zip(asked, answers, strict=False):
        each = [f"{edges_text(ids)}: {why}" if len(refused) > 1 else why for ids, why in by_reason(refused)]
        reason = "" if offers else seam.reason or " ".join(each)
        found.append(replace(seam, reason=reason, offers=tuple(offers), refused=refused, planned=True))
    rest = seams[len(found) :]
    return sorted([*found, *rest], key=lambda seam: (seam.purchased, bool(seam.reason)))


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
        "notes": list(shape.notes),
        "size_mm": [float(v) for v in 1e3 * np.ptp(shape.mesh.vertices, axis=0)],
        "edges": [as_row(edge) for edge in shape.edges],
        "report": str(folder / PAGE),
    }


def emit_table(shape: PartShape, seams: list[Seam], folder: Path, following: str, file: Path, verbose: bool) -> None:
    """Print what can be welded, the next command and the page; `verbose`: and each edge and refusal."""
    size = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(shape.mesh.vertices, axis=0))
    about = {"part": f"{shape.name}: {size} mm, {shape.bodies} bod{'ies' if shape.bodies > 1 else 'y'}"}
    last = {"note": " ".join(filter(None, [*shape.notes, outside_hint(shape)])), "unit": unit_hint(shape)}
    entries = page_rows(shape, seams)
    good, bad = ([e for e in entries if (e["state"] != "no") == wanted] for wanted in (True, False))
    last |= {"next": following or (typed("part", file) if good else ""), "page": f"{folder / PAGE} (-v: every edge)"}
    kinds = [_kinds(some) for some in (good, bad)]
    entries = [*kinds[0], *kinds[1]]
    named = [f"{word} {k + 1}" for word, some in zip(("seam", "not"), kinds, strict=True) for k in range(len(some))]
    for shown in range(len(entries), -1, -1):
        rows = {
            name: f"{e['named']}: {e['type']}, {e['length']} mm, {e['angle']} deg. {e['verdict']}{e['like']}"
            for name, e in list(zip(named, entries, strict=True))[:shown]
        }
        more = {"more": f"{len(entries) - shown} more, on the page"} if shown < len(entries) else {}
        most = None if verbose or shown <= 1 else MOST_LINES
        if emit_summary(f"part: {_headline(seams, good)}", about | rows | more | last, most=most):
            break
    if verbose:
        typer.echo(f"{'id':>4}  {'kind':8}  {'length mm':>9}  {'angle deg':>9}  {'radius mm':>9}  start -> end, mm")
        for edge in candidates(shape):
            length, angle, radius = _figures(edge)
            ends = " -> ".join("({:.1f}, {:.1f}, {:.1f})".format(*(1e3 * p)) for p in edge.points_P[[0, -1]])
            typer.echo(f"{edge.id:>4}  {edge.kind:8}  {length:>9}  {angle:>9}  {radius:>9}  {ends}")


def _kinds(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the first entry of each type, length, angle and state, with how many are like it."""
    found = dict[tuple[str, ...], list[dict[str, Any]]]()
    for entry in entries:
        kind = tuple(entry[key] for key in ("type", "length", "angle", "state"))
        found.setdefault(kind, []).append(entry)
    return [
        {**some[0], "like": f" {len(some) - 1} like it: {', '.join(e['named'] for e in some[1:])}." * (len(some) > 1)}
        for some in found.values()
    ]


def _headline(seams: list[Seam], good: list[dict[str, Any]]) -> str:
    asked = any(seam.planned for seam in seams)
    if not seams:
        return "no seams: no two bodies meet within 3 mm in a concave joint, and no body has a concave edge"
    if not good:
        return "no seam can be welded" if asked else "the tool fits no seam"
    yes = sum(len({tuple(one.edges) for one in o.seams}) for seam in seams for o in seam.offers)
    count = yes or len(good)
    what = f"{count} seam{'s' * (count > 1)}"
    if yes or all(entry["state"] == "yes" for entry in good):
        return f"{what} can be welded"
    return f"the tool fits {what}; the arm was not asked ({'no time was left' if asked else '--plan 0, or no time'})"


def _figures(edge: PartEdge) -> tuple[str, str, str]:
    angle = fixed(None if math.isnan(edge.angle_rad) else math.degrees(edge.angle_rad), 1)
    return fixed(1e3 * edge.length_m, 2), angle, fixed(None if edge.radius_m is None else 1e3 * edge.radius_m, 2)


def write_part(shape: PartShape, seams: list[Seam], folder: Path, make: Callable[[Sequence[int]], str]) -> None:
    """Write edges.csv and the page; `make`: the command for edges."""
    rows = [as_row(edge) for edge in shape.edges]
    table = [
        [" ".join(f"{v:.4f}" for v in cell) if isinstance(cell, list) else cell for cell in row.values()]
        for row in rows
    ]
    write_atomic(folder / "edges.csv", csv_text(COLUMNS, table))
    entries = page_rows(shape, seams, make)
    page = {
        "title": shape.name,
        "size": " × ".join(f"{1e3 * v:.1f}" for v in np.ptp(shape.mesh.vertices, axis=0)),
        "headline": _headline(seams, [entry for entry in entries if entry["state"] != "no"]),
        "scene": _scene(shape, entries),
    }
    write_atomic(folder / PAGE, render("part_3d.html.j2", page=page))


def page_rows(
    shape: PartShape, seams: list[Seam], make: Callable[[Sequence[int]], str] = lambda edges: ""
) -> list[dict[str, Any]]:
    """Return what is offered of each seam, and the edges that are refused with one reason, as the page shows them."""
    found = list[dict[str, Any]]()

    def add(seam: Seam, ids: Sequence[int], state: str, verdict: str, offer: Offer | None = None) -> None:
        edges = [shape.edge(id) for id in ids]
        row, j = seam.as_row(), seam.joint
        length = seam.joint.length_m if set(ids) == set(j.edges) else sum(edge.length_m for edge in edges)
        found.append(
            {
                "edges": list(ids),
                "named": edges_text([f"{e.id} ({side_of(e)})" if side_of(e) else e.id for e in edges]),
                "lines": [(1e3 * edge.points_P).round(2).tolist() for edge in edges],
                "type": f"{row['type']}{' of ' * bool(j.bodies)}{' and '.join(j.bodies)}",
                "length": f"{1e3 * length:.1f}",
                "angle": f"{row['angle_deg']:.0f}",
                "verdict": verdict[:1].upper() + verdict[1:],
                "state": state,
                "text": "" if offer is None else offer.lines,
                "command": "" if offer is None else make(offer.edges),
            }
        )

    for seam in seams:
        for offer in seam.offers:
            add(seam, offer.edges, "yes", replace(seam, offers=(offer,)).verdict, offer)
        if not seam.planned and not seam.reason:
            add(seam, [id for id in seam.joint.edges if id not in seam.refused], "fits", seam.verdict)
        refused = dict.fromkeys(seam.joint.edges, seam.reason) if not seam.planned and seam.reason else seam.refused
        for ids, why in by_reason(refused):
            add(seam, ids, "no", f"no: {seam.reason if len(seam.joint.edges) == 1 else why}")
    return sorted(found, key=lambda entry: ("yes", "fits", "no").index(entry["state"]))


def _scene(shape: PartShape, entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the part's largest triangles and its seams for the 3D page, mm."""
    mesh = shape.mesh
    largest = np.argsort(-np.linalg.norm(mesh.area_vectors, axis=1), kind="stable")[:MOST_DRAWN]
    used, index = np.unique(mesh.triangles[largest], return_inverse=True)
    return {
        "vertices": (1e3 * mesh.vertices[used]).round(3).tolist(),
        "triangles": index.reshape(-1, 3).tolist(),
        "seams": entries,
    }
