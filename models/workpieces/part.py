"""A part from a file with the seam that is welded on it, and what a weld needs to know of any workpiece."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.drawing import goes_on
from weldcal.models.workpieces.plate import Workpiece
from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.models.workpieces.seat import (
    JointNotWeldable,
    JointSection,
    Press,
    Seated,
    SeatedTip,
    TipApproach,
    check_weldable,
    hard_height,
    press_for,
    seat,
)
from weldcal.models.workpieces.shape import PartShape

Floats = npt.NDArray[np.float64]
LEAST_RADIUS_M = 0.100
SEEN_EDGE_M, FELT_EDGE_M = 0.012, 0.003  # longest edges: over 150 mm their middles are 0.12 mm and 8 um off


def bend(workpiece: Workpiece, radius_m: float) -> Workpiece:
    """The workpiece rolled over a cylinder of that radius (at its top face) whose axis lies along -y below its middle.

    Lengths along x stay what they are in the top face; (x, y, z) comes to ((r + z) sin(x/r), y, (r + z) cos(x/r) - r).
    The groove's walls keep their angle to the surface to within depth / radius.

    Raises:
        InputError: a radius below 100 mm, or a plate that would be bent by more than 60 degrees to either side.
    """
    if not (math.isfinite(radius_m) and radius_m >= LEAST_RADIUS_M):
        raise InputError(f"A plate is bent over at least {1e3 * LEAST_RADIUS_M:.0f} mm, not {1e3 * radius_m:.0f} mm.")
    if 0.5 * workpiece.size_m[0] > math.radians(60.0) * radius_m:
        raise InputError(
            f"A plate {1e3 * workpiece.size_m[0]:.0f} mm long does not go over a radius of {1e3 * radius_m:.0f} mm: "
            "make the seam shorter or the radius larger."
        )
    seam = rolled(workpiece.seam_P, radius_m)
    angle = workpiece.seam_P[:, 0] / radius_m
    t = workpiece.tangents_P
    stretched = t[:, 0] * (1.0 + workpiece.seam_P[:, 2] / radius_m)
    tangents = np.column_stack([stretched * np.cos(angle), t[:, 1], -stretched * np.sin(angle)])
    steps = np.linalg.norm(np.diff(seam, axis=0), axis=1)
    return replace(
        workpiece,
        name=f"{workpiece.name}_bent",
        mesh=_bent(workpiece.mesh, radius_m, SEEN_EDGE_M),
        groove_mesh=_bent(workpiece.groove_mesh, radius_m, FELT_EDGE_M),
        seam_P=seam,
        tangents_P=tangents / np.linalg.norm(tangents, axis=1, keepdims=True),
        arc_length_m=np.concatenate([[0.0], np.cumsum(steps)]),
        bend_radius_m=radius_m,
        up_P=np.column_stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)]),
    )


def rolled(points: Floats, radius_m: float) -> Floats:
    """Points (N,3) m of the flat plate, on the cylinder."""
    angle, r = points[:, 0] / radius_m, radius_m + points[:, 2]
    return np.column_stack([r * np.sin(angle), points[:, 1], r * np.cos(angle) - radius_m])


def _bent(mesh: TriMesh, radius_m: float, edge_m: float) -> TriMesh:
    fine = divided(mesh, edge_m)
    return TriMesh(rolled(fine.vertices, radius_m), fine.triangles)


def divided(mesh: TriMesh, edge_m: float) -> TriMesh:
    """Return the same surface with no edge that runs further than `edge_m` along x; closed where it was closed.

    Every edge that is too long is halved, for both of its triangles alike, and each triangle is cut anew.
    """
    points, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    while True:
        ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)  # (M, 3 edges, 2)
        long = np.abs(points[ends[..., 0], 0] - points[ends[..., 1], 0]) > edge_m
        if not long.any():
            return TriMesh(points, triangles)
        edges, which = np.unique(ends[long], axis=0, return_inverse=True)
        middle = np.full(long.shape, -1, dtype=np.int64)
        middle[long] = len(points) + which.ravel()
        points = np.vstack([points, points[edges].mean(axis=1)])
        pieces = [triangles[~long.any(axis=1)]]
        for cut in range(1, 4):
            some = np.flatnonzero(long.sum(axis=1) == cut)
            # Turned so that the edges to be halved come first, or the one that is not comes last.
            first = np.argmax(long[some], axis=1) if cut < 2 else (np.argmin(long[some], axis=1) + 1) % 3
            turn = (first[:, None] + np.arange(3)) % 3
            a, b, c = np.take_along_axis(triangles[some], turn, axis=1).T
            ab, bc, ca = np.take_along_axis(middle[some], turn, axis=1).T
            new = {
                1: [(a, ab, c), (ab, b, c)],
                2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
                3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
            }[cut]
            pieces += [np.column_stack(t) for t in new]
        triangles = np.vstack(pieces)


FELT_ABOUT_SEAM_M = 0.030
UNFELT_GAP_M = 0.002  # a butt joint no wider than this is welded without the tip, where the ball cannot feel it
BOWED_EDGE_M = 0.006
SELF_GUIDING_RAD = math.radians(29.0)  # half opening above which a pressed tip slides down either wall (friction 0.2)
GUIDED_DROP_M = 0.002  # from where it may land to the root, for a plan that is as far beside it
CHOSEN_END_M, FELT_END_M = 0.0003, 0.0015
HOVER_M = 0.003  # between the ball and the walls of a joint that it does not feel
BESIDE_M = 0.0017  # between the joint's mouth and the tip's centre as it lands on the face


class WeldPart(Protocol):
    """What a weld needs to know of a workpiece in its frame P, m: a grooved plate or a part from a file.

    ``mesh`` is what a scanner sees, groove_mesh what the tip feels; seam_P, tangents_P (N,3) the root line, up_P (N,3)
    or (1,3) the bisector of its walls, depth_m from their upper end to the root.
    """

    @property
    def name(self) -> str: ...
    @property
    def mesh(self) -> TriMesh: ...
    @property
    def groove_mesh(self) -> TriMesh: ...
    @property
    def seam_P(self) -> Floats: ...
    @property
    def tangents_P(self) -> Floats: ...
    @property
    def arc_length_m(self) -> Floats: ...
    @property
    def up_P(self) -> Floats: ...
    @property
    def size_m(self) -> tuple[float, float, float]: ...
    @property
    def section(self) -> JointSection: ...
    @property
    def half_angle_rad(self) -> float: ...
    @property
    def depth_m(self) -> float: ...
    @property
    def end_window_m(self) -> float:
        """How far from the drawn end the seam may end."""

    def seated(self, tip: SeatedTip, press: Press) -> Seated:
        """Where the centre of the loaded tip rests, from the root."""

    def press(self, tip: SeatedTip, axial_m: float | None, lateral_m: float | None) -> Press:
        """Return how deep the tip is pressed; a given value is used as it is."""

    def entry(self, tip: SeatedTip, seated: Seated) -> TipApproach:
        """How the tip is brought into the joint in which it then rests."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part in its frame P (that of its file) with a seam, and others that are welded before or after it, m.

    See WeldPart.
    """

    shape: PartShape
    seam: DrawnSeam
    others: tuple[DrawnSeam, ...] = ()

    @property
    def name(self) -> str:
        """The file's name."""
        return self.shape.name

    @property
    def mesh(self) -> TriMesh:
        """The whole surface."""
        return self.shape.mesh

    @cached_property
    def groove_mesh(self) -> TriMesh:
        """The surface about the seams."""
        points = np.concatenate([seam.points_P for seam in (self.seam, *self.others)])
        return about(self.shape.mesh, points, FELT_ABOUT_SEAM_M)

    @property
    def seam_P(self) -> Floats:
        """(N,3) the root line."""
        return self.seam.points_P

    @property
    def tangents_P(self) -> Floats:
        """(N,3) direction of travel."""
        return self.seam.tangents_P

    @property
    def arc_length_m(self) -> Floats:
        """(N,) along the root."""
        return self.seam.arc_length_m

    @property
    def up_P(self) -> Floats:
        """(N,3) bisector of the walls."""
        return self.seam.up_P

    @property
    def length_m(self) -> float:
        """Arc length of the seam."""
        return self.seam.length_m

    @cached_property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along x, y and z."""
        x, y, z = np.ptp(self.shape.mesh.vertices, axis=0)
        return float(x), float(y), float(z)

    @cached_property
    def section(self) -> JointSection:
        """The joint's walls in a cut square to the seam; the opening is the median along it."""
        left, right = self.seam.wall_height_m
        opening = math.pi if self.seam.joint == "butt" else float(np.median(self.seam.opening_rad))
        return JointSection(0.5 * opening, float(left), float(right), self.seam.gap_m)

    @property
    def half_angle_rad(self) -> float:
        """Between a wall and the bisector."""
        return self.section.half_angle_rad

    @property
    def depth_m(self) -> float:
        """From the end of the lower wall to the root, along the bisector.

        Of a gap 0, for its root is level with the faces.
        """
        return min(self.section.left_m, self.section.right_m) * math.cos(self.half_angle_rad)

    @cached_property
    def end_window_m(self) -> float:
        """See WeldPart; hardly any where the joint goes on beyond the drawn end.

        There the end is chosen, not felt.
        """
        return CHOSEN_END_M if goes_on(self.mesh, self.seam) else FELT_END_M

    def felt_by(self, tip: SeatedTip) -> bool:
        """Return whether the tip is used on this seam.

        As the seam's `feel` says, else not where level plates leave too narrow a gap.
        """
        if self.seam.feel is not None or self.seam.joint != "butt" or self.seam.gap_m > UNFELT_GAP_M:
            return self.seam.feel is not False
        return feels(self.section, tip)

    def seated(self, tip: SeatedTip, press: Press) -> Seated:
        """See WeldPart; a tip that is not used hangs HOVER_M clear of the walls."""
        if not self.felt_by(tip):
            clear = tip.tip_radius_m + HOVER_M
            return Seated(0.0, clear if self.section.gap_m > 0.0 else hard_height(self.section, clear))
        return seat(self.section, tip, press)

    def press(self, tip: SeatedTip, axial_m: float | None, lateral_m: float | None) -> Press:
        """See WeldPart: of the first of its seams that is felt; raises JointNotWeldable."""
        felt = next((p for k in range(seam_count(self)) if is_felt(p := numbered(self, k), tip)), None)
        if not isinstance(felt, Part):
            return Press(0.003, 0.002)  # it presses on nothing
        try:
            check_weldable(felt.section, tip.tip_radius_m)
            return press_for(felt.section, tip, axial_m, lateral_m)
        except JointNotWeldable as error:
            advice = "Or write feel: false with the seam: it is then followed from the scan and the drawing."
            raise JointNotWeldable(f"{error} {advice}") from error

    def entry(self, tip: SeatedTip, seated: Seated) -> TipApproach:
        """See WeldPart: a wide joint guides the tip in from above.

        Beside a narrow one it lands on the face and searches.
        """
        section = self.section
        if not self.felt_by(tip):
            return TipApproach(0.0, GUIDED_DROP_M)
        if section.gap_m == 0.0 and section.half_angle_rad >= SELF_GUIDING_RAD:
            return TipApproach(0.0, GUIDED_DROP_M)
        mouth = 0.5 * section.gap_m if section.gap_m else section.right_m * math.sin(section.half_angle_rad)
        return TipApproach(-(mouth + BESIDE_M), self.depth_m + tip.tip_radius_m - seated.above_m)


def feels(section: JointSection, tip: SeatedTip) -> bool:
    """Return whether a ball can feel a joint."""
    try:
        check_weldable(section, tip.tip_radius_m)
        press_for(section, tip)
    except JointNotWeldable:
        return False
    return True


def is_felt(part: WeldPart, tip: SeatedTip) -> bool:
    """Return whether the tip is used on the part's seam; on a grooved plate it is."""
    return not isinstance(part, Part) or part.felt_by(tip)


def seam_count(part: WeldPart) -> int:
    """How many seams are drawn on a part."""
    return 1 + len(part.others) if isinstance(part, Part) else 1


def numbered(part: WeldPart, seam: int) -> WeldPart:
    """Return the part with its seam of this number, counted from 0 in the order of welding; a plate has one."""
    if not isinstance(part, Part) or seam == 0:
        return part
    seams = (part.seam, *part.others)
    return Part(part.shape, seams[seam], (*seams[:seam], *seams[seam + 1 :]))


def about(mesh: TriMesh, points: Floats, reach_m: float) -> TriMesh:
    """Return the triangles of a mesh whose boxes come within reach of a line (N,3)."""
    corners = mesh.vertices[mesh.triangles]
    low, high = corners.min(axis=1) - reach_m, corners.max(axis=1) + reach_m
    near = np.zeros(len(corners), dtype=bool)
    for some in np.array_split(points, max(1, len(points) // 20)):
        near |= ((low <= some.max(axis=0)) & (high >= some.min(axis=0))).all(axis=1)
    used, index = np.unique(mesh.triangles[near], return_inverse=True)
    return TriMesh(mesh.vertices[used], index.reshape(-1, 3))


def bowed(part: Part, amplitude_m: float, direction: Floats) -> Part:
    """Return the part as made, bowed by an amplitude at its middle in a direction (3,).

    Its seam is not where the drawing has it.

    A point moves by amplitude cos(pi x) along the direction, x from -1/2 to 1/2 along the seam's chord; the ends stay.

    Raises:
        InputError: an amplitude beyond a twentieth of the seam.
    """
    seam = part.seam.points_P
    chord = seam[-1] - seam[0] if not part.seam.closed else np.ptp(seam, axis=0) * np.array([1.0, 0.0, 0.0])
    length = float(np.linalg.norm(chord))
    if amplitude_m > 0.05 * length:
        raise InputError(
            f"A part whose seam is {1e3 * length:.0f} mm long is not made {1e3 * amplitude_m:.1f} mm out of true."
        )
    e = chord / length
    middle = part.mesh.vertices @ e
    middle_at, span = 0.5 * float(middle.min() + middle.max()), float(np.ptp(middle))

    def moved(points: Floats) -> Floats:
        x = (points @ e - middle_at) / span
        return np.asarray(points + amplitude_m * np.cos(math.pi * x)[:, None] * direction)

    mesh = _divided_along(part.mesh, e, BOWED_EDGE_M)
    first, *others = (_moved_seam(s, moved) for s in (part.seam, *part.others))
    return Part(replace(part.shape, mesh=TriMesh(moved(mesh.vertices), mesh.triangles)), first, tuple(others))


def _moved_seam(s: DrawnSeam, moved: Callable[[Floats], Floats]) -> DrawnSeam:
    """Return the seam on a moved surface, its directions square to it."""
    points = moved(s.points_P)
    t = np.gradient(points, axis=0)
    t /= np.linalg.norm(t, axis=1, keepdims=True)

    def square(v: Floats) -> Floats:
        v = v - np.sum(v * t, axis=1, keepdims=True) * t
        return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))

    return replace(
        s, points_P=points, up_P=square(s.up_P), wall_left_P=square(s.wall_left_P), wall_right_P=square(s.wall_right_P)
    )


def _divided_along(mesh: TriMesh, e: Floats, edge_m: float) -> TriMesh:
    """Return the same surface with no edge that runs further than `edge_m` along a unit vector."""
    helper = np.array([0.0, 0.0, 1.0]) if abs(e[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    y = np.cross(helper, e)
    y /= np.linalg.norm(y)
    R = np.stack([e, y, np.cross(e, y)])
    fine = divided(TriMesh(mesh.vertices @ R.T, mesh.triangles), edge_m)
    return TriMesh(fine.vertices @ R, fine.triangles)
