"""Finds the joints of a part exactly, from the faces of its solids as OpenCascade has them; lengths in mm."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from OCP.BRepAdaptor import BRepAdaptor_Curve
from OCP.Geom import Geom_BSplineCurve
from OCP.GeomAbs import GeomAbs_CurveType
from OCP.GeomAPI import GeomAPI_IntCS, GeomAPI_IntSS, GeomAPI_ProjectPointOnCurve
from OCP.gp import gp_Pnt, gp_Vec
from OCP.TopAbs import TopAbs_ShapeEnum

from weldcal.models.errors import InputError
from weldcal.models.workpieces.brep import (
    BRIDGED_MM,
    EXACT_MM,
    IN_MM,
    Solid,
    SolidFace,
    array_of,
    called,
    length_of,
    listed,
    middle_of,
    of_opencascade,
    parts_of,
    sampled,
    unit,
)

Floats = npt.NDArray[np.float64]

GAP_MM, OVERLAP_MM = 3.05, 2.05  # between bodies; an overlap counts where two faces are flush
REACH_MM = 12.0  # from the root of a narrow V to its walls
CHAINED_MM = 0.05  # between the ends of pieces of one seam
LEAST_MM = 0.5  # length of a piece
FLUSH_MM = 0.2  # between two faces in one plane
FREE_MM = 2.0  # the joint is open at least this far: a clearance is no joint
GRAZING = 1e-3  # rad, between a line and a plane that crosses it
MOST_S = 25.0  # of processor time for a part's joints, of the 45 s in which a large file is read
WELDED = "the bodies that are welded, without threads, holes and purchased parts"
NARROW_RAD = math.radians(80.0)  # a V or HV is narrower


@dataclass(frozen=True, eq=False, kw_only=True)
class Piece:
    """A stretch of a joint where one face of a body meets one of another.

    Attributes:
        line: (N,3) mm; a closed one repeats its first point.
        up: (3,) unit, in the middle of the line, out of the joint.
        type: T, lap, corner, V, HV, butt or edge.
        angle: rad, through the free space.
        gap: mm, between the bodies.
        bodies: numbers of the two bodies.
        side: inside or outside of a corner, left or right of a web; else "".
        walls: mm, extent of the two walls from the root; of flush faces the depth of the joint.
        thick: mm, of the two bodies under their walls, beside the root.
        pipe: the type of a ring of such pieces: pipe on plate, pipe on pipe or flange on pipe; else "".
    """

    line: Floats
    up: Floats
    type: str
    angle: float
    gap: float
    bodies: tuple[int, int]
    side: str = ""
    walls: tuple[float, float] = (0.0, 0.0)
    thick: tuple[float, float] = (0.0, 0.0)
    pipe: str = ""


def joints_of(shape: Any) -> list[list[Piece]]:
    """Return the joints of a shape: see `joints_between`."""
    return joints_between([Solid(solid) for solid in parts_of(shape, TopAbs_ShapeEnum.TopAbs_SOLID)], [])


def joints_between(bodies: Sequence[Solid], notes: list[str], names: Sequence[str] = ()) -> list[list[Piece]]:
    """Find the joints between bodies, and where there are none those inside each of them.

    Each is the list of its pieces in the order of travel. The pairs of bodies at which OpenCascade fails are left out,
    and named in a sentence that is added to `notes`.

    Root lines are intersections of the faces' surfaces. Where a surface of another face crosses such a line, a piece
    may end; each stretch between two crossings is a joint or is none.

    After MOST_S those that are found are returned, of the largest bodies first, with a sentence in `notes`.

    Raises:
        InputError: none is found by then.
    """
    begin, bodies = time.process_time(), _Bodies(bodies)
    by_pair, failed = dict[tuple[int, ...], list[list[Piece]]](), list[str]()

    def search(pairs: Sequence[tuple[int, ...]], pieces: Callable[[tuple[int, ...]], Iterable[Piece]]) -> None:
        for count, pair in enumerate(pairs):
            try:
                by_pair[pair] = chains(pieces(pair))
            except _TimeUpError:
                if not any(by_pair.values()):
                    raise InputError(
                        f"The joints between {sum(len(body.faces) for body in bodies)} faces are not found within"
                        f" {MOST_S:.0f} s of processor time: export only {WELDED}."
                    ) from None
                notes.append(
                    f"The joints of {count} of {len(pairs)} {'pairs of ' * (len(pair) > 1)}bodies were found within"
                    f" {MOST_S:.0f} s of processor time, of the largest. For the others export only {WELDED}."
                )
                return
            except Exception as error:
                if not of_opencascade(error):
                    raise
                failed.append(" and ".join(called(names, k) for k in pair))

    size = [float(np.linalg.norm(body.high - body.low)) for body in bodies]
    near = [(i, j) for i, j in combinations(range(len(bodies)), 2) if not _far(bodies[i], bodies[j])]
    search(sorted(near, key=lambda pair: -min(size[k] for k in pair)), lambda pair: _pair(bodies, pair, begin))
    if not any(by_pair.values()):
        search([(k,) for k in range(len(bodies))], lambda pair: _within(bodies, pair[0], begin))
    if failed:
        notes.append(f"OpenCascade finds no joints of {listed(failed)}: repair their surfaces and export them again.")
    found = [chain for pair in sorted(by_pair) for chain in by_pair[pair]]  # numbered as the file has the bodies
    return [_named(chain, found) for chain in found]


class _Bodies(list[Solid]):
    """The bodies of a part with an index of their boxes: near a place there are few of many."""

    @cached_property
    def boxes(self) -> Floats:
        """Their corners (2,N,3), mm."""
        return np.array([[body.low for body in self], [body.high for body in self]])

    def near(self, low: Floats, high: Floats) -> list[Solid]:
        """Return those whose box meets the box between two corners, in the file's order."""
        return [self[k] for k in np.flatnonzero((self.boxes[0] <= high).all(1) & (self.boxes[1] >= low).all(1))]

    def hold(self, *places: Floats) -> bool:
        """Return whether any body holds any of the places."""
        return any(body.holds(p) for p in places for body in self.near(p, p))


def _pair(bodies: _Bodies, pair: tuple[int, ...], begin: float) -> Iterable[Piece]:
    """Return the pieces between two bodies."""
    i, j = pair
    a, b = bodies[i], bodies[j]
    for f in a.faces:
        if _far(f, b):
            continue
        _check_time(begin)
        for g in b.faces:
            if not _far(f, g):
                yield from _met(bodies, (i, j), f, g)
                yield from _flush(bodies, (i, j), f, g)


class _TimeUpError(Exception):
    """The joints are not found within MOST_S."""


def _check_time(begin: float) -> None:
    if time.process_time() - begin > MOST_S:
        raise _TimeUpError


def _within(bodies: _Bodies, k: int, begin: float) -> Iterable[Piece]:
    """Return the pieces along the concave edges of one body."""
    for edge, met in bodies[k].edges:
        if len(met) != 2:
            continue
        _check_time(begin)
        f, g = met
        curve = BRepAdaptor_Curve(edge)
        line = sampled(curve, curve.FirstParameter(), curve.LastParameter())
        if length_of(line) < LEAST_MM:
            continue
        cut = _cut(bodies, (k, k), f, g, *middle_of(curve, curve.FirstParameter(), curve.LastParameter()))
        if cut is not None:
            yield Piece(line=line, bodies=(k, k), **cut)


def _named(chain: list[Piece], all_of_them: list[list[Piece]]) -> list[Piece]:
    """The seam with the type of its longest piece; of a T with its side where there is one on the web's other side."""
    first = max(chain, key=lambda piece: length_of(piece.line))
    ring = closes(chain) and all(piece.pipe for piece in chain)
    chain = [replace(p, type=first.pipe if ring else first.type, side="" if ring else p.side) for p in chain]
    if first.type != "T" or ring or closes(chain):
        return chain
    first = chain[0]
    beside = [c[0] for c in all_of_them if c[0].type == "T" and c[0].bodies == first.bodies and len(c) == len(chain)]
    pair = [p for p in beside if abs(length_of(p.line) - length_of(first.line)) < 1.0]
    if len(pair) != 2:
        return chain
    other = pair[0] if pair[1].line is first.line else pair[1]
    along = first.line[-1] - first.line[0]
    along = along * np.sign(along[np.argmax(np.abs(along))])
    left = np.cross(first.up + other.up, along) @ (first.line.mean(axis=0) - other.line.mean(axis=0)) > 0.0
    return [replace(piece, side="left" if left else "right") for piece in chain]


def _far(a: SolidFace | Solid, b: SolidFace | Solid) -> bool:
    return bool((np.maximum(a.low, b.low) > np.minimum(a.high, b.high) + GAP_MM).any())


def _met(bodies: _Bodies, pair: tuple[int, int], f: SolidFace, g: SolidFace) -> Iterable[Piece]:
    """Return the pieces along which two faces meet in a concave joint."""
    if f.surface is None or g.surface is None:
        return
    if f.round and g.round and _coaxial(f, g, 0.01):
        return  # a pin in its hole
    crossing = GeomAPI_IntSS(f.surface, g.surface, 1e-6)
    if not crossing.IsDone():
        return
    low, high = np.maximum(f.low, g.low) - REACH_MM, np.minimum(f.high, g.high) + REACH_MM
    for k in range(crossing.NbLines()):
        curve = crossing.Line(k + 1)
        if curve.IsClosed() and isinstance(curve, Geom_BSplineCurve):
            curve.SetPeriodic()  # a stretch may go on past its first point
        breaks, closed = _breaks(bodies, curve, low, high, (f, g))
        kept = [(t, u, _between(bodies, pair, f, g, curve, t, u)) for t, u in pairwise(breaks)]
        runs: list[list[Any]] = []
        for t, u, cut in kept:
            if cut is not None and runs and length_of(sampled(curve, runs[-1][1], t)) <= BRIDGED_MM:
                longer = u - t > runs[-1][3]
                runs[-1] = [runs[-1][0], u, *((cut, u - t) if longer else runs[-1][2:])]
            elif cut is not None:
                runs.append([t, u, cut, u - t])
        if closed and len(runs) > 1 and runs[0][0] == breaks[0] and runs[-1][1] == breaks[-1]:
            first = runs.pop(0)
            runs[-1][1] += first[1] - first[0]
        for t, u, cut, _ in runs:
            line = sampled(curve, t, u)
            if length_of(line) >= LEAST_MM:
                yield Piece(line=line, bodies=pair, **cut)


def _between(
    bodies: _Bodies, pair: tuple[int, int], f: SolidFace, g: SolidFace, curve: Any, begin: float, end: float
) -> dict[str, Any] | None:
    """Return the joint of two faces along a stretch of their curve; None where they form none.

    A stretch no longer than the gap may lie beyond a wall's end: there the clearance of a slot's end is crossed.
    """
    x, t, length = middle_of(curve, begin, end)
    cut = _cut(bodies, pair, f, g, x, t, length)
    if cut is not None or length > BRIDGED_MM:
        return cut
    beyond = _cut(bodies, pair, f, g, x, t, length, 0.5 * length)
    return beyond if beyond is not None and length <= beyond["gap"] + CHAINED_MM else None


def _breaks(
    bodies: _Bodies, curve: Any, low: Floats, high: Floats, own: tuple[SolidFace, SolidFace]
) -> tuple[list[float], bool]:
    """Ascending parameters between which a curve is a joint as a whole or not at all, and whether it is closed."""
    closed = bool(curve.IsClosed())
    begin, end = curve.FirstParameter(), curve.LastParameter()
    if begin < -1e50:
        origin, along = gp_Pnt(), gp_Vec()
        curve.D1(0.0, origin, along)
        corners = np.array([[(low, high)[c >> k & 1][k] for k in range(3)] for c in range(8)])
        at = (corners - array_of(origin)) @ array_of(along)
        begin, end = float(at.min()), float(at.max())
    found = [begin, end]
    for body in bodies.near(low, high):
        for face in body.faces:
            if face in own or face.surface is None or (face.low > high).any() or (face.high < low).any():
                continue
            try:
                crossed = GeomAPI_IntCS(curve, face.surface)
            except Exception:  # of several types: no crossing can be computed
                continue
            met = [crossed.Parameters(k + 1)[2] for k in range(crossed.NbPoints())] if crossed.IsDone() else []
            # A plane along the line crosses it anywhere, by rounding.
            found += [t for t in met if face.along is None or abs(middle_of(curve, t, t)[1] @ face.along) > GRAZING]
    for face in own:
        for corner in face.corners:
            near = GeomAPI_ProjectPointOnCurve(corner, curve)
            if near.NbPoints() and near.LowerDistance() < REACH_MM:
                found.append(near.LowerDistanceParameter())
    if closed:
        found = [begin + (t - begin) % (end - begin) for t in found[2:]]
        found = [*found, min(found) + end - begin] if found else [begin, end]
    inside = sorted(t for t in found if begin - 1e-9 <= t and (closed or t <= end + 1e-9))
    points = [array_of(curve.Value(t)) for t in inside]
    kept = [0]
    for k in range(1, len(inside)):
        period = closed and k == len(inside) - 1
        if np.linalg.norm(points[k] - points[kept[-1]]) > 100.0 * EXACT_MM or (period and len(kept) == 1):
            kept.append(k)
        elif period:
            kept[-1] = k
    return [inside[k] for k in kept], closed


def _cut(
    bodies: _Bodies,
    pair: tuple[int, int],
    f: SolidFace,
    g: SolidFace,
    x: Floats,
    t: Floats,
    length: float,
    slack: float = 0.0,
) -> dict[str, Any] | None:
    """The joint of two faces in the cut at one point of their curve; None where they form no concave joint there.

    Args:
        length: of the stretch about the point, mm.
        slack: how far from the point a wall may end, along the curve, mm.
    """
    normals = f.normal(x), g.normal(x)
    cos = float(np.clip(normals[0] @ normals[1], -1.0, 1.0))
    if abs(cos) > math.cos(math.radians(10.0)):
        return None
    # Along each wall, away from the root, and how far from the root the wall begins.
    ways = unit(normals[1] - cos * normals[0]), unit(normals[0] - cos * normals[1])
    feet = f.foot(x), g.foot(x)
    begins = [float(np.linalg.norm(foot - x)) for foot in feet]
    if max(begins) > REACH_MM or max(abs(float((foot - x) @ t)) for foot in feet) > CHAINED_MM + slack:
        return None
    # Both walls are there where the one that begins farther away begins: below, one has another face towards the gap.
    for face, way in ((f, ways[0]), (g, ways[1])):
        p = x + (max(begins) + 0.5 * IN_MM) * way
        if np.linalg.norm(face.foot(p) - p) > 0.05 + slack + (0.0 if face.flat else 0.02 * max(begins) ** 2):
            return None
    gap = min(float(np.linalg.norm(other.foot(foot) - foot)) for other, foot in ((g, feet[0]), (f, feet[1])))
    if gap > GAP_MM:
        return None
    up = unit(normals[0] + normals[1])
    if bodies.hold(x + IN_MM * up, x + FREE_MM * up):
        return None
    two = bodies[pair[0]], bodies[pair[1]]
    angle = math.pi - math.acos(cos)
    deep, wall, goes_on = [], [], []
    for k in (0, 1):
        skin = x + (begins[k] + IN_MM) * ways[k] - 0.1 * normals[k]
        wall.append(begins[k] + IN_MM + two[k].through(skin, ways[k])[0])
        other, n = two[1 - k], normals[1 - k]
        back = begins[k] * ways[k] + IN_MM * (ways[k] - ways[1 - k])
        exits = [IN_MM + far for far in two[k].through(x + back, -ways[1 - k])]
        behind = [x - (far + 2.0 * IN_MM) * ways[1 - k] for far in exits]
        goes_on.append(any(other.holds(p - IN_MM * n) and not other.holds(p + IN_MM * n) for p in behind))
        # A ray meets a hole at a few places, the hollow of a tube at most.
        shares = (-0.4, -0.2, 0.2, 0.4) if f.flat and g.flat else ()
        places = [x + share * length * t + back for share in shares]
        deep.append(float(np.median([exits[0], *(IN_MM + two[k].through(p, -ways[1 - k])[0] for p in places)])))
    if any(goes_on):
        k = goes_on.index(True)
        kind, side = ("lap" if wall[k] < deep[k] else "T"), ""
    elif angle < NARROW_RAD:
        # A bevelled wall ends in an obtuse corner: there is material beyond its end.
        ends = [x + (wall[k] + 0.3) * ways[k] - 1.2 * normals[k] for k in (0, 1)]
        kind, side = ("V" if all(two[k].holds(ends[k]) for k in (0, 1)) else "HV"), ""
    else:
        narrow = [wall[k] < deep[k] for k in (0, 1)]
        kind, side = "corner", "outside" if all(narrow) else "inside"
        if narrow[0] != narrow[1]:
            k = narrow.index(True)  # the wall is the edge of a sheet: on another sheet, or beside a thinner one
            under = x - 2.0 * IN_MM * ways[1 - k] - IN_MM * normals[1 - k]
            kind, side = ("lap" if two[1 - k].holds(under) else "butt"), ""
    pipe = _of_pipe(f, g, t, two) if f.round or g.round else ""
    pipe = "" if kind == "lap" and pipe != "pipe on pipe" else pipe
    walls = wall[0], wall[1]
    roots = [x + (begins[k] + IN_MM) * ways[k] - 0.1 * normals[k] for k in (0, 1)]
    thick = tuple(0.1 + two[k].through(roots[k], -normals[k])[0] for k in (0, 1))
    found = {"up": up, "type": kind, "angle": angle, "gap": gap, "side": side, "walls": walls}
    return found | {"thick": thick, "pipe": pipe}


def _coaxial(a: SolidFace, b: SolidFace, angle_rad: float) -> bool:
    """Return whether two cylinders have one axis, also where these point against each other."""
    return any(a.axis.IsCoaxial(axis, angle_rad, GAP_MM) for axis in (b.axis, b.axis.Reversed()))


def _of_pipe(f: SolidFace, g: SolidFace, t: Floats, two: tuple[Solid, Solid]) -> str:
    """Return the joint of a pipe, "" for none: along a cylinder's axis it is as between plates."""
    axes = [(face, face.axis) for face in (f, g) if face.round]
    if len(axes) == 2:
        return "" if axes[0][1].IsParallel(axes[1][1], 0.1) else "pipe on pipe"
    if abs(float(array_of(axes[0][1].Direction()) @ t)) > 0.99:
        return ""
    pipe, plate = (f, two[1]) if f.round else (g, two[0])
    coaxial = two[0] is not two[1] and any(h.round and _coaxial(h, pipe, 1e-3) and h.sign > 0 for h in plate.faces)
    return "flange on pipe" if coaxial else "pipe on plate"


def _flush(bodies: _Bodies, pair: tuple[int, int], f: SolidFace, g: SolidFace) -> Iterable[Piece]:
    """The pieces along which two faces go on in each other: a square butt, the outside of a corner, an edge joint."""
    two = bodies[pair[0]], bodies[pair[1]]
    if f.flat != g.flat or f.round != g.round or not (f.flat or f.round):
        return
    for first, (p, n, m) in f.ends:
        for second, (q, other_n, other_m) in g.ends:
            if g.round:  # a circle may begin anywhere
                circle = BRepAdaptor_Curve(second).Circle()
                v = p - array_of(circle.Location())
                q = p - v + circle.Radius() * unit(v - (v @ other_m) * other_m)
                other_n = g.normal(q)
            if n @ other_n < 0.9999 or m @ other_m > -0.9999:
                continue
            gap = float((q - p) @ m)
            if not -OVERLAP_MM <= gap <= GAP_MM or abs(float((q - p) @ n)) > FLUSH_MM:
                continue
            line = _shared(first, second, m, gap)
            if line is None or length_of(line) < LEAST_MM:
                continue
            x = 0.5 * (line[0] + line[-1]) if f.flat else p + 0.5 * gap * m
            if bodies.hold(x + IN_MM * n, x + FREE_MM * n):
                continue
            starts = [x - (0.5 * gap + IN_MM) * m, x + (0.5 * gap + IN_MM) * m]
            depth = [IN_MM + two[k].through(starts[k] - IN_MM * n, -n)[0] for k in (0, 1)]
            wide = [two[k].through(starts[k] - 0.1 * n, s * m)[0] for k, s in ((0, -1.0), (1, 1.0))]
            if length_of(line) < min(depth) or not _facing(two, x, n, m, gap, min(depth)):
                continue
            across = min(body.through(starts[k] + 0.1 * n, n)[0] or math.inf for k, body in enumerate(two))
            if min(depth) > 0.5 * across:
                continue  # the rim of a hole or a slot through both bodies
            narrow = [wide[k] < 0.9 * depth[k] for k in (0, 1)]
            kind = "edge" if all(narrow) else "corner" if any(narrow) else "butt"
            side, walls = ("outside" if kind == "corner" else ""), (depth[0], depth[1])
            yield Piece(
                line=line,
                up=n,
                type=kind,
                angle=math.pi,
                gap=max(0.0, gap),
                bodies=pair,
                side=side,
                walls=walls,
                thick=walls,
            )


def _facing(two: tuple[Solid, Solid], x: Floats, n: Floats, m: Floats, gap: float, depth: float) -> bool:
    """Return whether both bodies are as near to each other below the flush faces: a groove is wider there."""
    down = x - min(1.0, 0.5 * depth) * n
    return all(two[k].holds(down + s * (0.5 * abs(gap) + 0.3) * m) for k, s in ((0, -1.0), (1, 1.0)))


def _shared(first: Any, second: Any, m: Floats, gap: float) -> Floats | None:
    """Return the line midway between two edges as far as both run beside each other; None where they do not."""
    a, b = BRepAdaptor_Curve(first), BRepAdaptor_Curve(second)
    ends = [[array_of(c.Value(u)) for u in (c.FirstParameter(), c.LastParameter())] for c in (a, b)]
    if a.GetType() != GeomAbs_CurveType.GeomAbs_Line:
        apart = [min(float(np.linalg.norm(p + gap * m - q)) for q in ends[1]) for p in ends[0]]
        centred = a.IsClosed() and b.IsClosed()
        on_axis = a.Circle().Location().Distance(b.Circle().Location()) < abs(gap) + FLUSH_MM
        if max(apart) > FLUSH_MM and not (centred and on_axis):
            return None
        return sampled(a, a.FirstParameter(), a.LastParameter()) + 0.5 * gap * m
    start, stop = ends[0]
    t = unit(stop - start)
    low, high = sorted(float((q - start) @ t) for q in ends[1])
    low, high = max(0.0, low), min(float((stop - start) @ t), high)
    return np.array([start + s * t for s in (low, high)]) + 0.5 * gap * m if high > low else None


def chains(pieces: Iterable[Piece]) -> list[list[Piece]]:
    """Pieces whose ends meet, each list in the order of travel and turned so that one follows the other."""
    left, found = list(pieces), []
    while left:
        chain = [left.pop(0)]
        for at in (-1, 0):
            while (k := next((k for k, p in enumerate(left) if _follows(chain, at, p)), None)) is not None:
                piece = left.pop(k)
                end = chain[at].line[at]
                if np.linalg.norm(piece.line[at] - end) < np.linalg.norm(piece.line[-1 - at] - end):
                    piece = replace(piece, line=piece.line[::-1])
                chain = [*chain, piece] if at else [piece, *chain]
        found.append(chain)
    return found


def _follows(chain: list[Piece], at: int, piece: Piece) -> bool:
    """Return whether a piece goes on where a chain ends (-1) or begins (0)."""
    gaps = np.linalg.norm(piece.line[[0, -1]] - chain[at].line[at], axis=1)
    same = (piece.angle > math.pi - 0.01) == (chain[at].angle > math.pi - 0.01)
    # Where the edges of two plates touch there is a joint on either side of one line.
    same = same and float(np.linalg.norm(piece.line.mean(axis=0) - chain[at].line.mean(axis=0))) > CHAINED_MM
    return bool(same and gaps.min() < CHAINED_MM and not closes([piece]) and not closes(chain))


def closes(chain: list[Piece]) -> bool:
    """Return whether a seam ends where it begins."""
    apart = float(np.linalg.norm(chain[0].line[0] - chain[-1].line[-1]))
    return apart < CHAINED_MM and sum(len(piece.line) for piece in chain) > 4
