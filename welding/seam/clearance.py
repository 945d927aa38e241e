"""Check that the tool fits at the part: its body along the whole seam, tip and torch beyond its ends."""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from weldcal.models.arms.urdf import Capsule
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.welding.numerics import Array, unit
from weldcal.welding.seam.curve import SeamCurve, SeamFrame

# A choice: above the errors of a registered part and of a calibrated arm, some tenths of a millimetre each.
CLEARANCE_M = 0.001
NEAR_TIP_M = 0.030  # finger and wire are in the joint by design: only what lies farther from the tip is checked
AHEAD_STEP_M = 0.002  # below the radius of a tip: it does not pass a wall between two rays
ACROSS_COS = 0.5  # a wall within 60 degrees of square to the way stops the tool
ASIDE_M = 0.003  # what the leaning tip still yields sideways before its mechanical limit
CLIMB_M = 0.010  # the wall of a groove, met at a slant, lifts the tip out over so much
BESIDE_M = 1e-7 * np.array([3.7, 6.1, 7.1])  # keeps rays off the edges between triangles, which would count twice
ASIDE_RAD = np.radians(np.arange(0.0, 181.0, 15.0))
SAMPLES = 20_000
STEP_M = 0.02  # along the seam; the tool, 20 mm and more wide, meets every place between
# From the part's surface: above a scan's noise and the registration's error, below the height of a tack, 3 mm and more.
OTHER_M = 0.0025
CELL_M, MOST_CELLS = 0.010, 1 << 20  # of points that are far from the tool together: a choice; cells along an axis
FEW = 1_000  # points whose median distance to the next is that of all within some hundredths
LEAST_AREA_M2 = 8e-6  # of a thing that is seen: less is a few flying points at an edge
STEP_BESIDE_M, LIFTED_M = 0.005, 0.1  # between the places along the seam, and above its ends
BLOCK_M = 0.005  # a choice: twice OTHER_M, on top of what the tool reaches below the table
LEAST_PIECE_M = 0.010  # of a seam beyond the place where the tip comes down
WIRE_M = 0.001  # radius of the wire with its play


class NoClearance(WeldcalError):
    """The tool's body would touch the part while the tip is in the joint.

    `short_m`: by how much its clearance is too small.
    """

    def __init__(self, sentence: str, short_m: float) -> None:
        super().__init__(sentence)
        self.short_m = short_m


def check_clearance(
    mesh: TriMesh,
    X_BP: RigidTransform,
    seam: SeamCurve,
    capsules: Sequence[Capsule],
    X_FT: RigidTransform,
    chord_m: float,
    lean_rad: float = 0.0,
) -> None:
    """Check the distance between the tool's capsules (in the flange frame) and the part's surface along the seam.

    The tool stands as the servo holds it: its axis along the mean of the bisectors at tip and torch, and leaning from
    it across the chord by `lean_rad`.

    Raises:
        NoClearance: less than 1 mm, with the place.
    """
    points = _sampled(mesh)
    points_B = points @ X_BP.rotation().matrix().T + X_BP.translation()
    spans = [span for capsule in capsules if (span := _above_tip(capsule, X_FT)) is not None]
    last = min(seam.drawn_m, seam.length + chord_m)
    for s in np.linspace(0.0, last, max(2, math.ceil(last / STEP_M) + 1)):
        tip, R = _held(seam, float(s), chord_m, lean_rad)
        points_T = (points_B - tip.position) @ R
        for a, b, radius in spans:
            near = float(_distances(points_T, a, b).min()) - radius
            if near < CLEARANCE_M:
                raise NoClearance(
                    f"The tool does not fit at {1e3 * s:.0f} mm of the seam: leaning to the joint's bisector its body"
                    f" would come within {1e3 * CLEARANCE_M:.0f} mm of the part ({1e3 * near:.1f} mm). Use a longer"
                    " finger or weld the joint from elsewhere.",
                    CLEARANCE_M - near,
                )


@lru_cache(4)
def _sampled(mesh: TriMesh) -> NDArray[np.float64]:
    """Return points (N,3) m on a mesh: the same for every edge of a part."""
    return mesh.sample(SAMPLES, np.random.default_rng(0))[0]


def check_beside(
    points_B: NDArray[np.float64],
    mesh: TriMesh,
    X_BP: RigidTransform,
    seam: SeamCurve,
    tool: WeldingTool,
    lean_rad: float = 0.0,
    table_z_m: float = -math.inf,
    stops: list[float] | None = None,
    from_m: float = 0.0,
) -> None:
    """Check that nothing that a scan (N,3) shows and the drawing does not is in the way of the tool.

    Such as a clamp or a tack.

    Tip, finger, torch and the tool's body along the seam from `from_m` on, and lifted off at both of its ends; below
    `table_z_m` it is the table. Where `stops` is given, the places of the tip at which something is in the way are
    added to it instead.

    Raises:
        NoClearance: with the place.
    """
    above = [span for capsule in tool.capsules() if (span := _above_tip(capsule, tool.X_FT)) is not None]
    spans = [(a, b, radius + CLEARANCE_M) for a, b, radius in above]
    wire, upward = np.array([-tool.chord_m, 0.0, tool.torch_height_m]), np.array([0.0, 0.0, NEAR_TIP_M])
    spans += [(np.zeros(3), upward, tool.tip_radius_m + CLEARANCE_M), (wire, wire + upward, WIRE_M + CLEARANCE_M)]
    last = min(seam.drawn_m, seam.length + tool.chord_m)
    steps = np.linspace(from_m, last, max(2, math.ceil((last - from_m) / STEP_BESIDE_M) + 1))
    lifts = np.arange(STEP_BESIDE_M, LIFTED_M, STEP_BESIDE_M)
    places = [(float(s), 0.0) for s in steps] + [(s, float(lift)) for s in (from_m, last) for lift in lifts]
    held = [(s, lift, *_held(seam, s, tool.chord_m, lean_rad)) for s, lift in places]
    ends = [tip.position + (np.add((a, b), [0.0, 0.0, up])) @ R.T for _, up, tip, R in held for a, b, _ in spans]
    near = _boxed(points_B, np.vstack(ends), max(radius for _, _, radius in spans))
    if len(near) < 2:
        return
    pitch = float(np.median(np.asarray(cKDTree(near).query(near[:: max(1, len(near) // FEW)], k=2)[0])[:, 1]))
    low = near.min(axis=0)
    corners = np.floor((near - low) / CELL_M).astype(np.int64)
    cells, cell = np.unique(corners @ (MOST_CELLS ** np.arange(3)), return_inverse=True)
    middles = low + CELL_M * (0.5 + cells[:, None] // MOST_CELLS ** np.arange(3) % MOST_CELLS)
    wide = 0.5 * math.sqrt(3.0) * CELL_M
    reached = [
        [_distances((middles - tip.position) @ R - [0.0, 0.0, lift], a, b) < radius + wide for a, b, radius in spans]
        for _, lift, tip, R in held
    ]
    kept = np.any(reached, axis=(0, 1))[cell]
    X_PB = X_BP.inverse()
    kept[kept] = mesh.distances(near[kept] @ X_PB.rotation().matrix().T + X_PB.translation(), signed=False) > OTHER_M
    other, cell = near[kept], cell[kept]
    flat = other[:, 2] < table_z_m + OTHER_M
    least = max(4, math.ceil(LEAST_AREA_M2 / max(pitch, 1e-5) ** 2))
    before: list[NDArray[np.int64]] = [np.empty(0, dtype=np.int64)] * len(spans)
    for (s, lift, tip, R), cells_met in zip(held, reached, strict=True):
        for k, (a, b, radius) in enumerate(spans):
            met = np.flatnonzero(cells_met[k][cell])
            met = met[_distances((other[met] - tip.position) @ R - [0.0, 0.0, lift], a, b) < radius]
            # tip and wire may be as near to a table that lies level with a wall as they are to this wall
            if k >= len(above):
                met = met[~flat[met]]
            both, before[k] = np.union1d(met, before[k]), met  # a tack is longer than a step and shorter than two
            if len(met) and len(both) >= least and stops is not None:
                stops.append(s)
            elif len(met) and len(both) >= least:
                x, y, z = np.median(other[both], axis=0)
                there = (
                    f"near ({1e3 * x:.0f}, {1e3 * y:.0f}, {1e3 * z:.0f}) mm in the base, at {1e3 * s:.0f} mm of the"
                    " seam"
                )
                if z < table_z_m + OTHER_M:
                    low = min(
                        float((at.position + np.add([a, b], [0.0, 0.0, up]) @ turn.T)[:, 2].min()) - wide
                        for _, up, at, turn in held
                        for a, b, wide in spans[: len(above)]
                    )
                    what = f"The tool would touch the table {there}"
                    change = f"raise the part by {math.ceil(1e3 * (table_z_m - low + BLOCK_M))} mm"
                else:
                    what, change = f"The tool would touch something that is not in the drawing {there}", "remove it"
                raise NoClearance(
                    f"{what}: {change}, or cut the seam with start_mm or end_mm, and scan again.", CLEARANCE_M
                )


def _boxed(points: NDArray[np.float64], about: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """Return the points (N,3) m that are not farther than `reach_m` from the box about others (M,3)."""
    low, high = about.min(axis=0) - reach_m, about.max(axis=0) + reach_m
    return np.asarray(points[((points >= low) & (points <= high)).all(axis=1)])


def clear_pieces(
    seam: SeamCurve, stops: Sequence[float], chord_m: float, run_up_m: float
) -> list[tuple[float, float, float]]:
    """Split a seam where something is in the way of the tool.

    For each piece its start and end and the place where the tip comes down, m.

    The tip is a chord ahead of the torch. A piece ends where the tip would meet a thing. The next one begins where the
    torch has passed it, and `run_up_m` later, when the torch is on the seam.
    """
    found = []
    edges = [-math.inf, *sorted(stops), math.inf]
    for before, after in pairwise(edges):
        first, last = before + STEP_BESIDE_M, after - STEP_BESIDE_M
        start = max(0.0, first - chord_m + run_up_m)
        end = min(seam.length, last - chord_m) if last < math.inf else seam.length
        if end - start > max(first - start, 0.0) + LEAST_PIECE_M:
            found.append((start, end, max(first, start)))
    return found


def check_ends(mesh: TriMesh, X_BP: RigidTransform, seam: SeamCurve, chord_m: float, tip_radius_m: float) -> None:
    """Check that nothing of the part blocks tip and torch beyond the seam's ends.

    The tip needs the space beyond its end, the torch that before its start.

    The tip runs `chord_m` ahead of the torch, straight on where the groove is drawn no further; the torch comes from as
    far behind its start. A wall met at a slant, as that of a curved joint cut short, leads the tip aside, or up and out
    of the groove. Where it is too high for that, as a web that the seam follows on its hollow side, it stops the tip.

    Raises:
        NoClearance: with how much of the seam to cut off.
    """
    triangles = mesh.transformed(X_BP).vertices[mesh.triangles]
    needed = chord_m + tip_radius_m
    for name, s, sign, who in (("end", seam.drawn_m, 1.0, "tip"), ("start", 0.0, -1.0, "torch")):
        inside = max(0.0, s - seam.length)
        if inside >= needed:
            continue
        free = inside + _free_length(triangles, seam.frame(s), sign, needed - inside, tip_radius_m)
        if free < needed:
            off = f"{1e3 * (needed - free) + 1.0:.0f} mm"
            by_length = name == "end" and seam.end is not None
            change = f"welding.seam_length_mm {off} smaller" if by_length else f"{name}_mm of the seam {off} larger"
            raise NoClearance(
                f"The part crosses the seam {1e3 * free:.0f} mm beyond its {name}, and the {who} needs"
                f" {1e3 * needed:.0f} mm there: set {change}, or weld it from elsewhere.",
                needed - free,
            )


def _free_length(triangles: NDArray[np.float64], frame: SeamFrame, sign: float, needed: float, ball_m: float) -> float:
    """Distance m from a seam's end along its tangent to the first wall that stops the tool; infinite without one."""
    origin, direction = np.asarray(frame.position), sign * np.asarray(frame.tangent)
    reach = needed + CLIMB_M
    near = triangles[(np.abs(triangles - origin).min(axis=1) < reach).all(axis=1) | _large(triangles, reach)]
    t, cosine = _crossings(near, origin, direction)
    t, cosine = t[t > 0.0], cosine[t > 0.0]
    across = t[cosine > ACROSS_COS]
    first = float(across.min()) if len(across) else math.inf
    aside = np.outer(np.cos(ASIDE_RAD), frame.normal) + np.outer(np.sin(ASIDE_RAD), frame.up)
    for s in np.arange(AHEAD_STEP_M, min(needed, first), AHEAD_STEP_M):
        inside = int(np.sum(np.sign(cosine[t <= s])))
        if inside > 0 and not any(_yields(near, origin + s * direction, d, inside, ball_m, frame) for d in aside):
            return float(t[(t <= s) & (cosine > 0.0)].max())
    return first


def _large(triangles: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """(M,) whether a triangle is so large that its corners do not show where it passes."""
    return np.asarray(np.ptp(triangles, axis=1).max(axis=1) > 0.5 * reach)


def _yields(
    triangles: NDArray[np.float64], p: Array, direction: Array, inside: int, ball_m: float, frame: SeamFrame
) -> bool:
    """Whether the tip, at a point p inside `inside` bodies, can be pushed out of them in a direction."""
    t, cosine = _crossings(triangles, p, direction)
    for k in np.argsort(t)[np.count_nonzero(t <= 0.0) :]:
        inside += 1 if cosine[k] > 0.0 else -1
        if inside == 0:
            push = (float(t[k]) + ball_m) * direction
            return bool(abs(push @ frame.normal) < ASIDE_M and push @ frame.up < CLIMB_M)
    return False


def _crossings(triangles: NDArray[np.float64], origin: Array, direction: Array) -> tuple[Array, Array]:
    """Compute the distances (K,) m at which a line along a unit vector crosses triangles (M,3,3).

    With its cosines (K,) with their inward normals.

    Source: Moeller and Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
    """
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, ac)
    det = np.sum(ab * p, axis=1)
    safe = np.where(np.abs(det) > 1e-15, det, np.inf)
    to = origin + BESIDE_M - a
    u = np.sum(to * p, axis=1) / safe
    q = np.cross(to, ab)
    v = (q @ direction) / safe
    hit = np.isfinite(safe) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    cosine = det[hit] / np.linalg.norm(np.cross(ab[hit], ac[hit]), axis=1)
    return np.asarray((np.sum(ac * q, axis=1) / safe)[hit]), np.asarray(cosine)


def _held(seam: SeamCurve, s: float, chord_m: float, lean_rad: float) -> tuple[SeamFrame, Array]:
    """The seam's frame at an arc length, and R_BT as the servo holds the tool there."""
    tip, torch = seam.frame(s), seam.frame(s - chord_m)
    up = unit(tip.up + torch.up, tip.up)
    x = tip.position - torch.position
    x = unit(x - (x @ up) * up, tip.tangent)
    y = math.cos(lean_rad) * np.cross(up, x) + math.sin(lean_rad) * up
    return tip, np.column_stack([x, y, np.cross(x, y)])


def _above_tip(capsule: Capsule, X_FT: RigidTransform) -> tuple[Array, Array, float] | None:
    """A capsule's axis in the tip frame, cut off near the tip; None where nothing is left."""
    X_TF = X_FT.inverse()
    a, b = (np.asarray(X_TF.multiply(np.asarray(end))) for end in (capsule.p_start, capsule.p_end))
    low, high = (a, b) if a[2] <= b[2] else (b, a)
    if high[2] < NEAR_TIP_M:
        return None
    if low[2] < NEAR_TIP_M:
        low = low + (NEAR_TIP_M - low[2]) / (high[2] - low[2]) * (high - low)
    return low, high, float(capsule.radius)


def _distances(points: NDArray[np.float64], a: Array, b: Array) -> Array:
    d, q = b - a, points - a
    q -= np.clip(q @ d / max(float(d @ d), 1e-12), 0.0, 1.0)[:, None] * d
    return np.asarray(np.sqrt(np.vecdot(q, q)))
