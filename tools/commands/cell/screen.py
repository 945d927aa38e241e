"""Which joints of a part a tool fits, and why not the others; the arm is not asked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from weldcal.systems.scenario.parts import LEAST_LEG_M
from weldcal.systems.scenario.schema import SeamConfig
from weldcal.tools.report.first_screen import typed
from weldcal.welding.seam.clearance import NoClearance, check_clearance
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam
from weldcal.welding.servo.tool_axes import check_ring, least_pipe_m

PIPE_TOOL = "pipe"
SMALL_M = 0.012  # a part this small may be drawn in inches
FLUSH_RAD = math.radians(179.0)  # a joint as open as this needs a gap for the tip to feel
MOST_TRIED = 4  # seams for which a place is looked for, and after these so many of their pieces
OPEN_ABOVE = 0.3  # z of the joint's bisector
LAP_MM = 5.0  # by which the pieces of a ring overlap
CORNER_COS = math.cos(math.radians(35.0))  # between two steps of a seam's line: a sharper turn is a corner
NARROW_RAD = math.radians(75.0)  # a V is narrower than this, a fillet wider


@dataclass(frozen=True, kw_only=True)
class Seam:
    """A joint of a part, its smallest radius in m (None: straight), and why a tool cannot weld it ("": it can).

    short_m: by how much the tool's clearance is too small; infinite where the joint itself is none for its ball.
    felt: by the tip; else it is followed from the scan and the drawing. planned: whether a new cell's arm was
    asked, too.
    pieces: in which pieces that arm welds it; "" for one.
    """

    joint: PartJoint
    radius_m: float | None
    reason: str
    short_m: float = 0.0
    felt: bool = True
    planned: bool = False
    pieces: str = ""

    @property
    def verdict(self) -> str:
        """Whether it can be welded, for a table."""
        if self.reason:
            return f"no: {self.reason}"
        yes = "yes" if self.planned else "fits the tool, not planned"
        yes = f"{yes}. {self.pieces}".removesuffix(". ")
        return yes if self.felt else f"{yes}; by the scan, not felt (its sigma comes with the scan)"

    def as_row(self) -> dict[str, Any]:
        """Return the seam for JSON: millimetres and degrees."""
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
            "pieces": self.pieces,
            "felt": self.felt,
        }


def ranked(shape: PartShape, tool: WeldingTool) -> list[Seam]:
    """Sort a part's joints: those that the tool can weld, longest first, then the others, nearest miss first.

    The arm is not asked.
    """
    found = []
    for joint in shape.joints:
        radii = [r for id in joint.edges if (r := shape.edge(id).radius_m) is not None]
        reason, short_m, felt = _obstacle(shape, joint, tool)
        radius = min(radii, default=None)
        found.append(Seam(joint=joint, radius_m=radius, reason=reason, short_m=short_m, felt=felt))
    return sorted(found, key=lambda seam: (bool(seam.reason), not seam.felt, seam.short_m, -seam.joint.length_m))


def _obstacle(shape: PartShape, joint: PartJoint, tool: WeldingTool) -> tuple[str, float, bool]:
    """Say why a tool does not fit a joint, by how much (m), and whether the joint is felt.

    Its ball is tried at the walls, its body at the middle of one of the edges.
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
        for id in joint.edges if ring is None else ():
            edge = shape.edge(id)
            assert edge.up_P is not None
            k = max(1, len(edge.points_P) // 2)
            along = edge.points_P[k] - edge.points_P[k - 1]
            middle = edge.points_P[k] if len(edge.points_P) > 2 else edge.points_P.mean(axis=0)
            tip = middle + hard_height(section, tool.tip_radius_m) * edge.up_P
            line = tip + np.linspace(-2e-3, 2e-3, 5)[:, None] * along / np.linalg.norm(along)
            seam = SeamCurve.from_points(line, up=np.tile(edge.up_P, (5, 1)))
            check_clearance(shape.mesh, RigidTransform(), seam, tool.capsules(), tool.X_FT, 0.0)
    except WeldcalError as error:
        reason = str(error).replace(" at 0 mm of the seam", "").replace(" at 4 mm of the seam", "")
        if ring is not None and isinstance(error, (NoClearance, InfeasibleSeam)):
            reason += least_pipe(shape, joint, tool)
        return reason, error.short_m if isinstance(error, NoClearance) else math.inf, felt
    return "", 0.0, felt


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
    far, across = max(joint.walls_m), 2.0 * float(np.linalg.norm(ring[0][0] - ring[0][:-1].mean(axis=0)))
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


def ways(shape: PartShape, ids: Sequence[int]) -> list[tuple[list[SeamConfig], str]]:
    """A seam along edges as a whole, and what it may be welded in: a ring in pieces that overlap, another edge by edge.

    Each with a note of the pieces, "" for the whole.
    """
    found, named = [([SeamConfig(edges=list(ids))], "")], ", ".join(map(str, ids))
    line, closed = chained(shape, ids)
    steps = np.diff(line[np.linalg.norm(np.diff(line, axis=0, prepend=np.nan), axis=1) != 0.0], axis=0)
    t = steps / np.linalg.norm(steps, axis=1)[:, None]
    if closed and (np.vecdot(t, np.roll(t, 1, axis=0)) > CORNER_COS).all():
        whole = 1e3 * sum(shape.edge(id).length_m for id in ids)
        ends = [round(share * whole, 1) for share in (0.25, 0.5)]
        edges, rest = list(ids), round(whole - ends[0] - LAP_MM, 1)
        # Both halves begin at one place: there the arm turns one way for the one and back for the other.
        halves = [
            SeamConfig(edges=edges, direction="reverse", start_mm=round(whole - ends[1] - LAP_MM, 1)),
            SeamConfig(edges=edges, start_mm=ends[1], end_mm=-LAP_MM),
        ]
        found.append((halves, f"The ring {named} in two halves that overlap by {LAP_MM:g} mm."))
        following = f"start_mm: {ends[0]:g}, end_mm: {round(rest - ends[0], 1):g}"
        quarter = f"For the next, subtract 90 from the last of pose_guess.rpy_deg and write {following}; and so on."
        found.append(([SeamConfig(edges=edges, end_mm=rest)], f"Only a quarter of the ring {named}. {quarter}"))
        return found
    by_length = sorted(ids, key=lambda id: -shape.edge(id).length_m) if len(ids) > 1 else []
    within = [id for id in ids if shape.edge(id).length_m > LEAST_LEG_M and not _below(shape.edge(id))]
    if 1 < len(within) < len(ids):
        left_out = ", ".join(str(id) for id in ids if id not in within)
        without = f"Without edges {left_out}, which are shorter than {1e3 * LEAST_LEG_M:.0f} mm or open downwards."
        found.append(([SeamConfig(edges=[id]) for id in within], without))
    return found + [([SeamConfig(edges=[id])], f"Only edge {id} of {named}.") for id in by_length]


def _below(edge: PartEdge) -> bool:
    """Return whether a joint opens downwards as the part is drawn, where no arm reaches it."""
    return edge.up_P is not None and float(edge.up_P[2]) < -OPEN_ABOVE


def joint_of(edge: PartEdge) -> str:
    """Return the kind of joint at an edge, by its angle."""
    if edge.kind == "flush":
        return "butt"
    return "v_groove" if edge.angle_rad < NARROW_RAD else "fillet"


def to_try(shape: PartShape, part: Path, tool: WeldingTool) -> list[list[PartEdge]]:
    """Return the seams to try, at most MOST_TRIED, each by its edges.

    Those that the tool fits come first, then those that it nearly fits; of these first what opens upwards.
    """
    found = []
    for seam in ranked(shape, tool):
        if not seam.felt or seam.joint.gap_m > 0.0 or seam.joint.angle_rad < FLUSH_RAD:
            above = seam.joint.up_P[2] > OPEN_ABOVE
            order = (bool(seam.reason), not seam.felt, round(seam.short_m, 3), not above)
            found.append((order, [shape.edge(id) for id in seam.joint.edges]))
    chains = [chain for _, chain in sorted(found, key=lambda pair: pair[0])]
    if not shape.joints:  # of a mesh of other surfaces
        concave = [edge for edge in shape.edges if edge.kind == "concave"]
        chains = [[edge] for edge in sorted(concave, key=lambda edge: -edge.length_m)]
    if not chains:
        raise InputError(
            f"{part.name} has no concave edge: choose edges with '{typed('part', part)}' and give --edges."
        )
    return chains[:MOST_TRIED]
