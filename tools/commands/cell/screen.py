"""Which joints of a part a tool fits, why not the others, and in which pieces a seam may be welded."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import load_tool, tool_file
from weldcal.models.workpieces.part import UNFELT_GAP_M, feels
from weldcal.models.workpieces.seam_input import chained
from weldcal.models.workpieces.seat import JointSection, check_weldable, hard_height
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartJoint, PartShape
from weldcal.welding.seam.clearance import NoClearance, check_clearance
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam
from weldcal.welding.servo.tool_axes import check_ring, least_pipe_m

if TYPE_CHECKING:
    from weldcal.systems.scenario.schema import PoseConfig, SeamConfig

# What belongs to a cell is imported where it is used: the list of a part's seams needs none of it.

PIPE_TOOL = "pipe"
SMALL_M = 0.012  # a part this small may be drawn in inches
OPEN_ABOVE = 0.3  # z of the joint's bisector
LAP_MM = 5.0  # by which the pieces of a ring overlap
CORNER_COS = math.cos(math.radians(35.0))  # between two steps of a seam's line: a sharper turn is a corner
UNLIKE, LEAST_PLATE_M = 5.0, 8e-4  # ratio of two thicknesses that are not welded to each other; the least thickness
MOST_PLATE_M = 0.012  # a plate thicker than this makes a seam no more important: a choice
PURCHASED = re.compile(
    r"bolt|screw|washer|rivet|cast[eo]r|\bnuts?\b|\bnut_|\b(din|iso|ansi)[ _]?\d{3}|\bm\d+ ?x ?\d|wood|\bmdf\b"
    r"|schraube|mutter|scheibe",
    re.IGNORECASE,
)  # names of what is not welded
NARROW_RAD = math.radians(75.0)  # a V is narrower than this, a fillet wider


@dataclass(frozen=True, kw_only=True)
class Offer:
    """What of a part's edges a cell's arm can weld with the part in one pose.

    ``note``: in which pieces, or without which edges and why; "" where it is all of them as one seam.
    scan_poses_deg: of a scanner on the flange.
    """

    seams: list[SeamConfig]
    joint: str
    pose: PoseConfig
    note: str = ""
    scan_poses_deg: list[list[float]]

    @property
    def edges(self) -> list[int]:
        """The edges that are welded, each once, in the order of the seam."""
        return list(dict.fromkeys(id for seam in self.seams for id in seam.edges))

    @property
    def lines(self) -> str:
        """The lines of a scenario's workpiece that order it."""
        from weldcal.tools.commands.cell.schema import yaml_of

        return f"  seams: {yaml_of(self.seams)}\n  joint: {self.joint}"


@dataclass(frozen=True, kw_only=True)
class Seam:
    """A joint of a part, its smallest radius in m (None: straight), and why a tool cannot weld it ("": it can).

    ``short_m``: by how much the tool's clearance is too small; infinite where the joint itself is none for its ball.
    felt: by the tip; else it is followed from the scan and the drawing. planned: whether a new cell's arm was
    asked, too.
    offers: what that arm can weld of it; refused: why not, by edge.
    """

    joint: PartJoint
    radius_m: float | None
    reason: str
    short_m: float = 0.0
    felt: bool = True
    planned: bool = False
    offers: tuple[Offer, ...] = ()
    refused: Mapping[int, str] = field(default_factory=dict)

    @property
    def purchased(self) -> bool:
        """Whether a body of it is a purchased part by its name."""
        return any(PURCHASED.search(name) for name in self.joint.bodies)

    @property
    def verdict(self) -> str:
        """Whether it can be welded, for a table."""
        if self.reason:
            return f"no: {self.reason}"
        yes = " ".join(["yes." if self.planned else "fits the tool, not planned.", *(o.note for o in self.offers)])
        yes = yes.strip().removesuffix(".")
        return yes if self.felt else f"{yes}; by the scan, not felt (its sigma comes with the scan)"

    def as_row(self) -> dict[str, Any]:
        """Return the seam for JSON: millimetres and degrees."""
        j, offers = self.joint, []
        if self.offers:
            from weldcal.tools.commands.cell.schema import yaml_of

            offers = [{"edges": o.edges, "lines": o.lines, "pose_guess": yaml_of(o.pose)} for o in self.offers]
        return {
            "type": f"{j.type} {j.side}".strip(),
            "bodies": list(j.bodies),
            "edges": list(j.edges),
            "length_mm": 1e3 * j.length_m,
            "angle_deg": math.degrees(j.angle_rad),
            "gap_mm": 1e3 * j.gap_m,
            "least_radius_mm": None if self.radius_m is None else 1e3 * self.radius_m,
            "plates_mm": [1e3 * thick for thick in j.thick_m],
            "throat_mm": 1e3 * min(j.walls_m) * math.cos(0.5 * j.angle_rad) if j.walls_m[0] else None,
            "closed": j.closed,
            "weldable": not self.reason,
            "reason": self.reason,
            "planned": self.planned,
            "pieces": " ".join(offer.note for offer in self.offers if offer.note),
            "offers": offers,
            "refused": {str(id): why for id, why in self.refused.items()},
            "felt": self.felt,
        }


def used_s() -> float:
    """Return the processor time of this process and of those that have read a part for it, s."""
    return sum(os.times()[:4])


def side_of(edge: PartEdge) -> str:
    """Return the side of the part on which a joint opens, along an axis of its file, as "-y"; "" of an edge of none."""
    if edge.up_P is None:
        return ""
    k = int(np.argmax(np.abs(edge.up_P[:2])))
    k = k if abs(edge.up_P[k]) > OPEN_ABOVE else 2
    return ("+" if edge.up_P[k] > 0.0 else "-") + "xyz"[k]


def ranked(shape: PartShape, tool: WeldingTool) -> list[Seam]:
    """Sort a part's joints as a welder would: those that the tool can weld first, then the nearest misses.

    Purchased parts come after all of them; plates of unlike thickness after the others of their kind. The felt and the
    upward ones come first, then those with the largest length times thinner plate. The arm is not asked.

    Of a part without joints, as a mesh of other surfaces, its concave edges are taken.
    """
    found = []
    for joint in shape.joints or _creases(shape):
        radii = [r for id in joint.edges if (r := shape.edge(id).radius_m) is not None]
        refused, felt = _obstacles(shape, joint, tool) if shape.joints else ({}, True)
        short_m = max((short for _, short in refused.values()), default=0.0)
        why, reason = {id: words for id, (words, _) in refused.items()}, ""
        if refused and len(refused) < len(joint.edges):
            short_m = 0.0  # the rest is welded
        elif refused:
            id, reason = next(iter(why.items()))
            reason = f"edge {id}: {reason}" if len(refused) > 1 and reason.startswith("The tool does not") else reason
        radius = min(radii, default=None)
        found.append(Seam(joint=joint, radius_m=radius, reason=reason, short_m=short_m, felt=felt, refused=why))
    return sorted(found, key=lambda seam: _order(shape, seam))


def _order(shape: PartShape, seam: Seam) -> tuple[Any, ...]:
    j, thin, thick = seam.joint, min(seam.joint.thick_m), max(seam.joint.thick_m)
    unlike = thick > 0.0 and (thin < LEAST_PLATE_M or thick > UNLIKE * thin)  # a board on a tube, a shaft in a sheet
    length_m = j.length_m - sum(shape.edge(id).length_m for id in seam.refused if not seam.reason)
    worth = round(length_m * min(thin or MOST_PLATE_M, MOST_PLATE_M), 7)  # m2
    above = j.up_P[2] > OPEN_ABOVE
    fits = seam.purchased, bool(seam.reason), unlike, not seam.felt, round(seam.short_m, 3)
    return (*fits, not above, seam.short_m, -worth)


def alike(seams: Sequence[Seam]) -> list[list[int]]:
    """Return the numbers of the seams in groups of one type, length, angle, thickness and verdict, each as ranked."""
    found = dict[tuple[Any, ...], list[int]]()
    for k, seam in enumerate(seams):
        j = seam.joint
        sizes = round(1e3 * j.length_m), round(math.degrees(j.angle_rad)), round(1e4 * min(j.thick_m)), len(j.edges)
        found.setdefault((j.type, *sizes, not seam.reason, seam.planned, bool(seam.offers)), []).append(k)
    return list(found.values())


def _creases(shape: PartShape) -> list[PartJoint]:
    return [
        PartJoint(type="crease", edges=(e.id,), length_m=e.length_m, angle_rad=e.angle_rad, up_P=np.array([0, 0, 1.0]))
        for e in shape.edges
        if e.kind == "concave"
    ]


def _obstacles(shape: PartShape, joint: PartJoint, tool: WeldingTool) -> tuple[dict[int, tuple[str, float]], bool]:
    """Say why a tool does not fit edges of a joint, by how much (m), by edge; and whether the joint is felt.

    Its ball is tried at the walls, its body at the middle of each edge.
    """
    flush = joint.angle_rad > math.pi - 0.01
    half, gap = (0.5 * math.pi, joint.gap_m) if flush else (0.5 * joint.angle_rad, 0.0)
    section, felt = JointSection(half, *joint.walls_m, gap), True
    ring = _ring(shape, joint)
    try:
        felt = not flush or gap > UNFELT_GAP_M or feels(section, tool)
        if felt:
            check_weldable(section, tool.tip_radius_m)
        if ring is not None:
            check_ring(shape.mesh, *ring, section, tool)
    except WeldcalError as error:
        why = _why(error)
        if ring is not None and isinstance(error, (NoClearance, InfeasibleSeam)):
            why = why[0] + least_pipe(shape, joint, tool), why[1]
        return dict.fromkeys(joint.edges, why), felt
    found = dict[int, tuple[str, float]]()
    for id in joint.edges if ring is None else ():
        edge = shape.edge(id)
        assert edge.up_P is not None
        k = max(1, len(edge.points_P) // 2)
        along = edge.points_P[k] - edge.points_P[k - 1]
        middle = edge.points_P[k] if len(edge.points_P) > 2 else edge.points_P.mean(axis=0)
        tip = middle + hard_height(section, tool.tip_radius_m) * edge.up_P
        line = tip + np.linspace(-2e-3, 2e-3, 5)[:, None] * along / np.linalg.norm(along)
        try:
            seam = SeamCurve.from_points(line, up=np.tile(edge.up_P, (5, 1)))
            check_clearance(shape.mesh, RigidTransform(), seam, tool.capsules(), tool.X_FT, 0.0)
        except WeldcalError as error:
            found[id] = _why(error)
    return found, felt


def _why(error: WeldcalError) -> tuple[str, float]:
    reason = str(error).replace(" at 0 mm of the seam", "").replace(" at 4 mm of the seam", "")
    return reason, error.short_m if isinstance(error, NoClearance) else math.inf


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


def least_pipe(shape: PartShape, joint: PartJoint, tool: WeldingTool) -> str:
    """Name the least pipe whose outside the tool can weld onto a plate, both as far as the joint's longer wall.

    It is "" for a joint that is none of these.
    """
    ring = _ring(shape, joint)
    if ring is None or float(ring[1][0] @ (ring[0][0] - ring[0][:-1].mean(axis=0))) <= 0.0:
        return ""
    far, across = round(max(joint.walls_m), 3), 2.0 * float(np.linalg.norm(ring[0][0] - ring[0][:-1].mean(axis=0)))
    words = f" The least pipe for this tool is {1e3 * least_pipe_m(tool, far):.0f} mm across."
    other = load_tool(tool_file(Path(PIPE_TOOL))).tool
    if tool.chord_m <= other.chord_m or across < least_pipe_m(other, far):
        return words
    return f"{words} The tool {PIPE_TOOL} fits: part --tool {PIPE_TOOL}, new --tool-file {PIPE_TOOL}."


def unit_hint(shape: PartShape) -> str:
    """What a part so small that its file may be in inches asks; "" for any other."""
    size = np.ptp(shape.mesh.vertices, axis=0)
    if max(size) >= SMALL_M or shape.unit_m != UNITS_M["mm"]:
        return ""
    return "The part is only {:.1f} x {:.1f} x {:.1f} mm: its unit may be inch; check the file.".format(*(1e3 * size))


def outside_hint(shape: PartShape) -> str:
    """Return what a part asks whose corners are listed inside only, as those of a mitre; "" for any other."""
    sides = [joint.side for joint in shape.joints if joint.type == "corner"]
    if sides.count("inside") <= sides.count("outside"):
        return ""
    return "The outside of a corner that opens more than 180 deg is not listed and cannot be welded: weld its inside."


def ways(shape: PartShape, ids: Sequence[int]) -> list[tuple[list[SeamConfig], str, bool]]:
    """What edges may be welded in, the whole first: a ring in pieces that overlap, others edge by edge.

    Each with a note of the pieces, "" for the whole, and whether some of its seams may be left out.
    """
    from weldcal.systems.scenario.schema import SeamConfig

    runs, named = followed(shape, ids), ", ".join(map(str, ids))
    found = [([SeamConfig(edges=run) for run in runs], "", False)]
    line, closed = chained(shape, runs[0])
    steps = np.diff(line[np.linalg.norm(np.diff(line, axis=0, prepend=np.nan), axis=1) != 0.0], axis=0)
    t = steps / np.linalg.norm(steps, axis=1)[:, None]
    if len(runs) == 1 and closed and (np.vecdot(t, np.roll(t, 1, axis=0)) > CORNER_COS).all():
        whole = 1e3 * sum(shape.edge(id).length_m for id in ids)
        ends = [round(share * whole, 1) for share in (0.25, 0.5)]
        edges, rest = list(ids), round(whole - ends[0] - LAP_MM, 1)
        # Both halves begin at one place: there the arm turns one way for the one and back for the other.
        halves = [
            SeamConfig(edges=edges, direction="reverse", start_mm=round(whole - ends[1] - LAP_MM, 1)),
            SeamConfig(edges=edges, start_mm=ends[1], end_mm=-LAP_MM),
        ]
        found.append((halves, f"The ring {named} in two halves that overlap by {LAP_MM:g} mm.", False))
        following = f"start_mm: {ends[0]:g}, end_mm: {round(rest - ends[0], 1):g}"
        quarter = f"For the next, subtract 90 from the last of pose_guess.rpy_deg and write {following}; and so on."
        found.append(([SeamConfig(edges=edges, end_mm=rest)], f"Only a quarter of the ring {named}. {quarter}", False))
    elif len(ids) > 1 and (within := [id for id in ids if not unfit(shape.edge(id))]):
        found.append(([SeamConfig(edges=[id]) for id in within], "", True))
    return found


def followed(shape: PartShape, ids: Sequence[int]) -> list[list[int]]:
    """Return edges as runs that follow each other, each a seam of its own."""
    runs = [[ids[0]]]
    for id in ids[1:]:
        try:
            chained(shape, [*runs[-1], id])
            runs[-1].append(id)
        except InputError:
            shape.edge(id)
            runs.append([id])
    return runs


def unfit(edge: PartEdge) -> str:
    """Why an edge of a longer seam is not worth a plan, "" where it is."""
    from weldcal.systems.scenario.parts import LEAST_LEG_M

    if edge.length_m <= LEAST_LEG_M:
        return f"shorter than the {1e3 * LEAST_LEG_M:.0f} mm that the tip needs."
    below = edge.up_P is not None and float(edge.up_P[2]) < -OPEN_ABOVE
    return "open downwards as drawn, where no arm reaches." if below else ""


def without(ids: Sequence[int], refused: Mapping[int, str]) -> str:
    """Say which edges are left out, and why; "" for none."""
    why = {id: refused.get(id, "in another pose of the part.") for id in ids}
    return " ".join(f"Without {edges_text(some)}: {reason}" for some, reason in by_reason(why))


def by_reason(refused: Mapping[int, str]) -> list[tuple[list[int], str]]:
    """Return the edges that share a reason, with it, in their order."""
    found = dict[str, list[int]]()
    for id, why in refused.items():
        found.setdefault(why, []).append(id)
    return [(ids, why) for why, ids in found.items()]


def edges_text(ids: Sequence[object]) -> str:
    """Name edges: "edge 5", "edges 5, 6"."""
    return f"edge{'s' * (len(ids) > 1)} {', '.join(map(str, ids))}"


def joint_of(edge: PartEdge) -> str:
    """Return the kind of joint at an edge, by its angle."""
    if edge.kind == "flush":
        return "butt"
    return "v_groove" if edge.angle_rad < NARROW_RAD else "fillet"
