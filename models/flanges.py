"""Tool flanges by ISO 9409-1:2004: dimensions and meshes.

Frame R: origin at the circle centre in the plane of the flat face, z the outward face normal; the body lies at z < 0.

Where the numbers come from:

- Pitch circle, holes, thread, bore, dowel: ISO 9409-1:2004, Table 1, as public CAD sources quote it. Outside: its d2.
  The edition of 1996 has M5 on 40, six holes on 63 and eight on 160; robots with six on 63 are still sold.
- The dowel hole midway between two holes: User Manuals UR10e, 8.7.5 (four holes) and UR20, 8.11.3 (six holes).
- Bore depth 6 mm, threads 8 mm deep: measured on Universal Robots' UR5 mesh (wrist3.dae). UR3e, UR5e, UR10e and UR20
  have bores of 6.2 mm. For the sizes other than 50 and 80 the depth is a choice.
- Chamfer 1 mm: the same meshes (1.05 mm on the UR20).
"""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from weldcal.models.documents import did_you_mean
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, circle, merge, plane_mesh, revolve, triangulate_polygon, wall

Floats = npt.NDArray[np.float64]

_DASH = r"[\s\-_/\u2010-\u2015]*"
_CATALOGUE = re.compile(
    rf"(?:(?:(?:din|en|iso|tool|flange){_DASH})*9409{_DASH}1{_DASH}(?::{_DASH}\d{{4}})?{_DASH})?(?:a{_DASH})?"
    rf"(31[.,]5|\d{{2,3}})[\s\-_/\u2010-\u2015]+(\d{{1,2}}){_DASH}(?:x{_DASH})?m(\d{{1,2}})"
)

_OWN = re.compile(
    r"ring-(?P<outer>\d+(?:\.\d+)?)-(?P<bore>\d+(?:\.\d+)?)"
    r"(?:-(?P<pitch>\d+(?:\.\d+)?)-(?P<holes>\d{1,2})-m(?P<thread>\d{1,2}))?(?:-c(?P<chamfer>\d+(?:\.\d+)?))?"
)
"""A circle of one's own: "ring-90-63" (outer diameter and bore, mm), "ring-90-63-76-6-m5" (pitch circle, holes),
"ring-90-63-c0.5" (chamfer of its edges, 1 mm without)."""

PAPER_RADIUS_M = 0.031
"""Radius that the flange calibration paper searches for, though ISO 9409-1-50 is 63 mm across: the edge carries a 1 mm
chamfer, so the outermost points lie between 30.5 mm (end of the flat face) and 31.5 mm, and 31 is their middle."""

LEAST_RING_M, LARGEST_RING_M = 0.030, 0.250  # of an own circle: a scan hardly shows less, no arm carries more

CIRCLE_SEGMENTS = 256
"""Default facets of a full turn: the chord of a 63 mm circle then lies at most 2.4 micrometres inside it."""


@dataclass(frozen=True, kw_only=True)
class FlangeStandard:
    """A tool flange or a flange-like ring, in metres and radians (angles about z of frame R, from x).

    `outer_m` and `bore_m` are the diameters ISO calls d2 and d3; the flat face between the chamfers is narrower by one
    chamfer at each edge. `hole_m` is the visible hole diameter: the nominal thread, as a countersunk
    hole shows it (some CAD draws the tap drill, 5 mm for M6). A plain ring has no holes and no pin (`pin_m` = 0), and
    its bore goes through (`bore_depth_m` = inf).
    """

    designation: str
    pitch_circle_m: float
    outer_m: float
    bore_m: float
    bore_depth_m: float
    n_holes: int
    thread: str
    hole_m: float
    hole_angles_rad: tuple[float, ...]
    pin_m: float
    pin_angle_rad: float
    chamfer_m: float = 0.001
    hole_depth_m: float = 0.008

    def __post_init__(self) -> None:
        inner, outer = self.face_inner_radius_m, self.face_outer_radius_m
        if self.chamfer_m < 0.0 or not 0.0 < inner < outer:
            raise InputError(f"Flange '{self.designation}' has no flat face left: make its bore or chamfer smaller.")
        for x, y, radius in self.openings():
            reach = math.hypot(x, y)
            if reach - radius <= inner or reach + radius >= outer:
                raise InputError(f"A hole of flange '{self.designation}' leaves its flat face: check the pitch circle.")

    @property
    def outer_radius_m(self) -> float:
        """Radius of the outside cylinder, m."""
        return 0.5 * self.outer_m

    @property
    def bore_radius_m(self) -> float:
        """Radius of the bore, m."""
        return 0.5 * self.bore_m

    @property
    def face_outer_radius_m(self) -> float:
        """Where the flat face ends and the outer chamfer begins, m."""
        return 0.5 * self.outer_m - self.chamfer_m

    @property
    def face_inner_radius_m(self) -> float:
        """Where the flat face ends and the bore's chamfer begins, m."""
        return 0.5 * self.bore_m + self.chamfer_m

    def openings(self) -> tuple[tuple[float, float, float], ...]:
        """(x, y, radius) in R of every thread and of the dowel hole, m."""
        pitch = 0.5 * self.pitch_circle_m
        holes = [(a, 0.5 * self.hole_m) for a in self.hole_angles_rad]
        if self.pin_m > 0.0:
            holes.append((self.pin_angle_rad, 0.5 * self.pin_m))
        return tuple((pitch * math.cos(a), pitch * math.sin(a), r) for a, r in holes)


def _iso(pitch: str, n: int, thread: int, outer: float, bore: float, bore_depth: float, pin: float) -> FlangeStandard:
    """One row of the table, in millimetres; the dowel hole at 90 degrees, midway between two of the even holes."""
    first = math.pi / 2 + math.pi / n
    angles = tuple(sorted((first + 2.0 * math.pi * k / n) % (2.0 * math.pi) for k in range(n)))
    return FlangeStandard(
        designation=f"iso9409-1-{pitch}-{n}-m{thread}",
        pitch_circle_m=float(pitch) * 1e-3,
        outer_m=outer * 1e-3,
        bore_m=bore * 1e-3,
        bore_depth_m=bore_depth * 1e-3,
        n_holes=n,
        thread=f"M{thread}",
        hole_m=thread * 1e-3,
        hole_angles_rad=angles,
        pin_m=pin * 1e-3,
        pin_angle_rad=math.pi / 2,
    )


def flange_ring(
    outer_m: float,
    bore_m: float,
    *,
    designation: str = "ring",
    bore_depth_m: float = math.inf,
    chamfer_m: float = 0.001,
) -> FlangeStandard:
    """Return a flange-like ring without holes (a tool's calibration ring, the rim of a wrist); diameters in metres."""
    return FlangeStandard(
        designation=designation,
        pitch_circle_m=outer_m,
        outer_m=outer_m,
        bore_m=bore_m,
        bore_depth_m=bore_depth_m,
        n_holes=0,
        thread="",
        hole_m=0.0,
        hole_angles_rad=(),
        pin_m=0.0,
        pin_angle_rad=0.0,
        chamfer_m=chamfer_m,
    )


STANDARDS: dict[str, FlangeStandard] = {
    flange.designation: flange
    for flange in (
        #    d1     N  d4   d2    d3   depth d5
        _iso("31.5", 4, 5, 40.0, 20.0, 6.0, 5.0),
        _iso("40", 4, 6, 50.0, 25.0, 6.0, 6.0),
        _iso("50", 4, 6, 63.0, 31.5, 6.0, 6.0),
        _iso("63", 4, 6, 80.0, 40.0, 6.0, 6.0),
        _iso("63", 6, 6, 80.0, 40.0, 6.0, 6.0),
        _iso("80", 6, 8, 100.0, 50.0, 6.0, 8.0),
        _iso("100", 6, 8, 125.0, 63.0, 6.0, 8.0),
        _iso("125", 6, 10, 160.0, 80.0, 6.0, 10.0),
        _iso("160", 6, 10, 200.0, 100.0, 6.0, 10.0),
        # The rim of a UR10e's last joint round its 63 mm flange: what a coarse time-of-flight camera can still see.
        flange_ring(0.090, 0.063, designation="wrist-ring-90"),
        # The ring on the welding tool, made to the face dimensions of ISO 9409-1-50 so that one fit serves both.
        flange_ring(0.063, 0.0315, designation="tool-ring-63"),
    )
}
"""Every flange known by name."""


def is_part_file(name: str) -> bool:
    """Whether the name of a flange is that of a part's file, whose ring models/tools/own_ring finds."""
    return name.lower().endswith((".step", ".stp", ".stl", ".obj", ".ply"))


def _own_circle(name: str, own: re.Match[str]) -> FlangeStandard:
    """Return the circle that a name such as "ring-90-63-76-6-m5" describes, its first hole on x. Raises InputError."""
    outer, bore, pitch = (1e-3 * float(own[key] or 0.0) for key in ("outer", "bore", "pitch"))
    if not LEAST_RING_M <= outer <= LARGEST_RING_M:
        low, high = 1e3 * LEAST_RING_M, 1e3 * LARGEST_RING_M
        raise InputError(f"The circle '{name}' must be {low:.0f} to {high:.0f} mm wide: ring-OUTER-BORE, in mm.")
    if bore <= 0.0:
        raise InputError(f"The circle '{name}' needs a bore: ring-OUTER-BORE, in mm.")
    ring = flange_ring(outer, bore, designation=name, chamfer_m=1e-3 * float(own["chamfer"] or 1.0))
    if not own["holes"]:
        return ring
    n, thread = int(own["holes"]), int(own["thread"])
    angles = tuple(2.0 * math.pi * k / n for k in range(n))
    return replace(
        ring, pitch_circle_m=pitch, n_holes=n, thread=f"M{thread}", hole_m=1e-3 * thread, hole_angles_rad=angles
    )


def get_flange(name: str, *, pin_angle_rad: float | None = None) -> FlangeStandard:
    """Return the flange of that designation, also as catalogues write it ("ISO 9409-1 - 50 - 4 - M6", "50-4-M6").

    "ring-90-63" is a circle of one's own, 90 mm wide with a bore of 63 mm; "ring-90-63-76-6-m5" one with holes.
    `pin_angle_rad` moves the dowel hole, which is at 90 degrees otherwise.

    Raises InputError naming the known ones.
    """
    plain = name.strip().lower()
    iso = _CATALOGUE.fullmatch(plain)
    plain = (
        f"iso9409-1-{iso[1].replace(',', '.')}-{iso[2]}-m{iso[3]}" if iso else plain.replace(" ", "-").replace(",", ".")
    )
    own = _OWN.fullmatch(plain)
    flange = STANDARDS.get(plain) if own is None else _own_circle(plain, own)
    if flange is None:
        if not name:
            raise InputError(
                "No flange is named: write 'flange:' in dataset.yaml, or add --flange; known are"
                f" {', '.join(STANDARDS)}."
            )
        listed = f"use one of {', '.join(STANDARDS)}, or ring-OUTER-BORE in mm for a circle of your own."
        raise InputError(f"Flange '{name}' is not known: {did_you_mean(name, STANDARDS, listed)}")
    return flange if pin_angle_rad is None else replace(flange, pin_angle_rad=pin_angle_rad)


def flange_mesh(
    standard: FlangeStandard,
    thickness_m: float = 0.012,
    *,
    chamfers: bool = True,
    holes: bool = True,
    segments: int = CIRCLE_SEGMENTS,
) -> TriMesh:
    """Return the solid flange in frame R: face at z = 0 looking +z, watertight, blind bore and holes.

    `chamfers` = False leaves sharp edges (the vendors' CAD, which biases ICP); a bore at least as deep as the flange is
    thick goes through. Raises InputError when the thickness cannot hold the holes.
    """
    c = standard.chamfer_m if chamfers else 0.0
    openings = standard.openings() if holes else ()
    depth = standard.hole_depth_m
    if thickness_m <= max(c, depth if openings else 0.0):
        raise InputError(f"A flange {thickness_m * 1e3:.3g} mm thick cannot hold its holes: make it thicker.")
    outer, bore = standard.outer_radius_m, standard.bore_radius_m
    through = standard.bore_depth_m >= thickness_m
    floor = -thickness_m if through else -standard.bore_depth_m

    # Everything but the flat face, from the rim of the face down round the body and up the bore (material to the left).
    inside = [(bore, floor), (bore, -c), (bore + c, 0.0)]
    outside = [(outer - c, 0.0), (outer, -c), (outer, -thickness_m)]
    if not chamfers or c == 0.0:
        inside, outside = [(bore, floor), (bore, 0.0)], [(outer, 0.0), (outer, -thickness_m)]
    if through:
        bodies = [revolve(np.array([*inside[::-1], *outside[::-1]]), segments)]
    else:
        bodies = [
            revolve(np.array([(0.0, floor), *inside]), segments),
            revolve(np.array([*outside, (0.0, -thickness_m)]), segments),
        ]
        bodies = [body.flipped() for body in bodies]

    # Holes get as many facets as keep their chords shorter than the rims' (a Delaunay face then respects every rim).
    rims = [circle(bore + c, segments)]
    rims += [circle(r, max(24, int(segments * r / bore)), (x, y)) for x, y, r in openings]
    face_outline = circle(outer - c, segments)
    face = plane_mesh(np.concatenate([face_outline, *rims]), triangulate_polygon(face_outline, rims), 0.0, up=True)
    pockets = []
    for rim in rims[1:]:
        pockets += [wall(rim[::-1], -depth, 0.0), plane_mesh(rim, triangulate_polygon(rim), -depth, up=True)]
    return merge(face, *bodies, *pockets, tolerance_m=1e-9)
