"""Draws a seam on a part: from a rough line to the joint's exact root with its walls, cut by cut."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.seams import SPACING_M, DrawnSeam
from weldcal.models.workpieces.section import PROBES_M, Opening, Section, cut, opening_angle, openings, wall_extent

Floats = npt.NDArray[np.float64]

EXACT_M = 1e-7  # between a line and the root that a second pass would leave as it is
FARTHEST_M = 0.003  # between a drawn line and the root of the joint
WIDEST_GAP_M = 0.008
NO_GAP_M = 1e-6  # between triangles of one face, or plates that touch: the seam is then where its line is
OPENINGS_DEG = {"v_groove": (15.0, 155.0), "fillet": (50.0, 155.0), "lap": (50.0, 155.0), "butt": (155.0, 200.0)}
SHEET_M = 0.012  # a lap's upper sheet is at most this thick
_SMOOTH_M = 0.0015
_NUDGE_M = 5e-5  # at its ends a seam's cut is taken inside the part
_TRIMMED_M = 0.002  # a line may end this far beyond the part
_CORNER_RAD = math.radians(25.0)


def draw_seam(
    mesh: TriMesh, line: Floats, joint: str, normals: Floats | None = None, closed: bool = False
) -> DrawnSeam:
    """Return the seam along a line (N,3) m in P, N >= 2, at the joint nearest to it.

    Args:
        normals: (N,3), roughly out of the joint towards the tool; needed only where a line lies at two joints.

    Raises:
        InputError: the part has no such joint along the line, and what it has instead.
    """
    points, ups = resampled(line, normals, closed)
    found = None
    for _ in range(2):  # the second time from the root that the first has found
        tangents = directions(points, closed)
        found = _fitted(mesh, points, tangents, ups, joint, closed)
        if len(found.root) == len(points) and np.abs(found.root - points).max() < EXACT_M:
            break  # the line is the root already, as an edge of a part
        points, ups, closed = found.root, found.up, closed and found.whole
    assert found is not None
    if joint == "lap" and min(found.height) > SHEET_M:
        raise InputError(
            f"joint: lap does not fit this seam: neither wall ends within {1e3 * SHEET_M:.0f} mm; write joint: fillet."
        )
    return _even(found, joint, closed)


def goes_on(mesh: TriMesh, seam: DrawnSeam, by_m: float = 0.004) -> bool:
    """Return whether the joint continues beyond the seam's end, by the cut a little further on."""
    if seam.closed:
        return True
    t, up = seam.tangents_P[-1:], seam.up_P[-1:]
    (section,) = cut(mesh, seam.points_P[-1:] + by_m * t, t, up)
    return _chosen(section, seam.joint, seam.up_P[-1]) is not None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
    root: Floats
    up: Floats
    left: Floats
    right: Floats
    gap_m: float
    height: tuple[float, float]
    whole: bool


def resampled(line: Floats, normals: Floats | None, closed: bool) -> tuple[Floats, Floats | None]:
    """Return the line at even spacing with the normals carried along; a closed one ends where it starts.

    Raises:
        InputError: less than two different points, or shorter than 4 mm.
    """
    p = np.asarray(line, dtype=np.float64)
    if closed and np.linalg.norm(p[0] - p[-1]) > 1e-6:
        p = np.vstack([p, p[:1]])
        normals = None if normals is None else np.vstack([normals, normals[:1]])
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    keep = np.concatenate([[True], steps > 1e-7])
    p = p[keep]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    if len(p) < 2 or s[-1] < 0.004:
        raise InputError(
            f"A seam needs two different points at least 4 mm apart; this one is {1e3 * s[-1]:.2f} mm long."
        )
    at = np.linspace(0.0, s[-1], max(9, round(s[-1] / SPACING_M) + 1))
    even = np.column_stack([np.interp(at, s, p[:, k]) for k in range(3)])
    if normals is None:
        return even, None
    n = np.asarray(normals, dtype=np.float64)[keep]
    return even, np.column_stack([np.interp(at, s, n[:, k]) for k in range(3)])


def directions(points: Floats, closed: bool, over_m: float = 0.0015) -> Floats:
    """Unit tangents (N,3) over a few points; within reach of a corner those of its nearer leg."""
    n = len(points)
    k = min(max(1, round(over_m / SPACING_M)), n - 1)
    index = np.arange(n)
    if closed:
        ahead, behind = points[(index + k) % (n - 1)], points[(index - k) % (n - 1)]
        here = points
    else:
        ahead, behind = points[np.minimum(index + k, n - 1)], points[np.maximum(index - k, 0)]
        here = points
    forward, backward = _unit(ahead - here), _unit(here - behind)
    t = _unit(ahead - behind)
    turn = np.arccos(np.clip(np.sum(forward * backward, axis=1), -1.0, 1.0))
    sharp = (turn > _CORNER_RAD) & (np.linalg.norm(ahead - here, axis=1) > 1e-9)
    sharp &= np.linalg.norm(here - behind, axis=1) > 1e-9
    for i in np.flatnonzero(sharp).tolist():
        # The corner lies where the turn is largest; before it the leg behind counts.
        begin = max(0, i - k)
        corner = begin + int(np.argmax(turn[begin : i + k + 1]))
        t[i] = backward[i] if i <= corner else forward[i]
    return t


def _fitted(mesh: TriMesh, points: Floats, t: Floats, ups: Floats | None, joint: str, closed: bool) -> _Fit:
    """One pass: the cuts at every point, the joint's walls in each, and the roots where they meet."""
    inside = points.copy()
    inside[0] += _NUDGE_M * t[0]
    inside[-1] -= _NUDGE_M * t[-1]
    hint = np.broadcast_to(_across(t[0]), t.shape) if ups is None else ups
    hint = np.where(np.linalg.norm(np.cross(hint, t), axis=1, keepdims=True) < 1e-3, _across_each(t), hint)
    sections = cut(mesh, inside, t, hint)
    wanted = _start(sections, ups, joint)
    n = len(points)
    root, up, left, right = (np.full((n, 3), np.nan) for _ in range(4))
    gaps = np.full(n, np.nan)
    for i, section in enumerate(sections):
        best = _chosen(section, joint, wanted)
        if best is None:
            continue
        opening, at, gap = best
        root[i] = points[i] + section.space(at)
        bisector = opening.normal_left + opening.normal_right
        up[i] = section.space(bisector / np.linalg.norm(bisector))
        left[i], right[i] = section.space(opening.normal_left), section.space(opening.normal_right)
        gaps[i] = gap
        wanted = up[i]
    good = np.isfinite(root[:, 0])
    if not good.any():
        raise InputError(_nothing(sections, joint, points))
    first, last = int(np.argmax(good)), n - 1 - int(np.argmax(good[::-1]))
    trimmed = max(first, n - 1 - last) * SPACING_M
    holes = int((~good[first : last + 1]).sum()) * SPACING_M
    if (trimmed > _TRIMMED_M or holes > 0.1 * n * SPACING_M + 2e-3) and not (closed and trimmed <= holes):
        at_mm = 1e3 * SPACING_M * int(np.argmin(good))
        raise InputError(
            f"Along {1e3 * SPACING_M * (~good).sum():.1f} mm of the seam, first at {at_mm:.1f} mm, the part has no"
            f" {joint} joint within {1e3 * FARTHEST_M:.0f} mm of the line. Check the line, its unit and the joint."
        )
    keep = slice(first, last + 1)
    s = np.arange(n)[keep]
    full = [_filled(a[keep], good[keep], s) for a in (root, up, left, right)]
    root, up, left, right = (_smoothed(a, closed, t[keep]) for a in full)
    left, right, up = _unit(left), _unit(right), _unit(up)
    gap = float(np.nanmedian(gaps)) if joint == "butt" else 0.0
    some = [i for i in range(first, last + 1) if good[i]]
    heights = _heights(
        [sections[i] for i in some[:: max(1, len(some) // 12)]], joint, wanted_of=up, first=first, some=some
    )
    return _Fit(root=root, up=up, left=left, right=right, gap_m=gap, height=heights, whole=first == 0 and last == n - 1)


def _start(sections: list[Section], ups: Floats | None, joint: str) -> Floats:
    """The direction (3,) out of the joint at the seam's start, from the first cut that shows exactly one such joint."""
    for i, section in enumerate(sections):
        if ups is not None:
            if _chosen(section, joint, ups[i]) is not None:
                return np.asarray(ups[i])
            continue
        found = [o for radius in PROBES_M[:1] for o in openings(section, radius) if _fits(o, joint)]
        found = found or [o for o in openings(section, PROBES_M[-1]) if _fits(o, joint)]
        if len(found) == 1:
            return section.space(found[0].middle)
        if len(found) > 1 and i > len(sections) // 2:
            raise InputError(
                f"The line lies at {len(found)} joints at once: give the direction of the tool as nx, ny, nz in the"
                " seam's file."
            )
    return sections[0].up


def _fits(opening: Opening, joint: str) -> bool:
    low, high = OPENINGS_DEG[joint]
    # The walls' normals tell the joint's angle even where the line is drawn beside the root.
    return low <= math.degrees(opening_angle(opening)) <= high and math.degrees(opening.width_rad) < 230.0


def _chosen(section: Section, joint: str, wanted: Floats) -> tuple[Opening, Floats, float] | None:
    """Return the joint's opening that points most nearly as wanted, its root (2,), and a butt joint's gap.

    None without one.
    """
    aim = np.array([wanted @ section.right, wanted @ section.up])
    for radius in PROBES_M:
        found = [o for o in openings(section, radius) if _fits(o, joint) and o.middle @ aim > 0.3]
        for opening in sorted(found, key=lambda o: -float(o.middle @ aim)):
            at, gap = _gap_at(section, opening) if joint == "butt" else (_meeting(opening), 0.0)
            if at is not None and np.linalg.norm(at) <= (FARTHEST_M if joint != "butt" else WIDEST_GAP_M):
                return opening, at, gap
    return None


def _meeting(opening: Opening) -> Floats | None:
    """Where the lines of the two walls meet (2,), None where they are parallel."""
    a = np.stack([opening.normal_right, opening.normal_left])
    if abs(np.linalg.det(a)) < 0.2:
        return None
    b = np.array([opening.normal_right @ opening.point_right, opening.normal_left @ opening.point_left])
    return np.asarray(np.linalg.solve(a, b))


def _gap_at(section: Section, opening: Opening) -> tuple[Floats | None, float]:
    """Middle of the gap between two level plates, level with their faces, and its width m."""
    n = opening.normal_left + opening.normal_right
    n = n / np.linalg.norm(n)
    x = np.array([n[1], -n[0]])
    flat = section.normals @ n > math.cos(math.radians(20.0))
    level = 0.5 * float(n @ (opening.point_left + opening.point_right))
    flat &= (np.abs(section.segments @ n - level) < 0.0015).all(axis=1)
    if not flat.any():
        return None, 0.0
    spans = np.sort(section.segments[flat] @ x, axis=1)
    # The largest stretch near the line that no face covers.
    spans = spans[np.argsort(spans[:, 0])]
    best, middle, reached = -1.0, 0.0, float(spans[0, 0])
    for low, high in spans:
        if low > reached and reached < WIDEST_GAP_M and low > -WIDEST_GAP_M and low - reached > best:
            best, middle = float(low) - reached, 0.5 * (float(low) + reached)
        reached = max(reached, float(high))
    if not NO_GAP_M < best <= WIDEST_GAP_M:
        return (None, 0.0) if best > WIDEST_GAP_M else (level * n, 0.0)
    return middle * x + level * n, best


def _heights(
    sections: list[Section], joint: str, wanted_of: Floats, first: int, some: list[int]
) -> tuple[float, float]:
    """Usable extent of the left and the right wall, m: the least of several cuts."""
    step = max(1, len(some) // 12)
    found = []
    for section, i in zip(sections, some[::step], strict=True):
        best = _chosen(section, joint, wanted_of[i - first])
        if best is None:
            continue
        opening, root, gap = best
        n_l, n_r = opening.normal_left, opening.normal_right
        if joint == "butt":
            n = (n_l + n_r) / np.linalg.norm(n_l + n_r)
            x = np.array([n[1], -n[0]])
            depth = [wall_extent(section, root + side * 0.5 * gap * x, -n, -side * x) for side in (-1.0, 1.0)]
            found.append((depth[0], depth[1]))
            continue
        found.append(
            (
                wall_extent(section, root, np.array([-n_l[1], n_l[0]]), n_l),
                wall_extent(section, root, np.array([n_r[1], -n_r[0]]), n_r),
            )
        )
    if not found:
        return 0.0, 0.0
    middle = np.array(found[1:-1] if len(found) > 4 else found)
    return float(middle[:, 0].min()), float(middle[:, 1].min())


def _even(found: _Fit, joint: str, closed: bool) -> DrawnSeam:
    """Return the seam evenly spaced along its root."""
    steps = np.linalg.norm(np.diff(found.root, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, s[-1], max(5, round(s[-1] / SPACING_M) + 1))

    def along(values: Floats) -> Floats:
        return np.column_stack([np.interp(at, s, values[:, k]) for k in range(3)])

    return DrawnSeam(
        points_P=along(found.root),
        up_P=_unit(along(found.up)),
        wall_left_P=_unit(along(found.left)),
        wall_right_P=_unit(along(found.right)),
        joint=joint,
        wall_height_m=np.array(found.height),
        gap_m=found.gap_m,
        closed=closed,
    )


def _nothing(sections: list[Section], joint: str, points: Floats) -> str:
    """Why no cut shows the joint: the part is elsewhere, or the free space at the line is another."""
    low, high = OPENINGS_DEG[joint]
    seen = [math.degrees(opening_angle(o)) for s in sections for o in openings(s, PROBES_M[1])]
    middle = 1e3 * points[len(points) // 2]
    where = f"at ({middle[0]:.1f}, {middle[1]:.1f}, {middle[2]:.1f}) mm"
    if not any(len(s.segments) for s in sections):
        return f"The seam's line is off the part: {where} nothing of it lies within 25 mm; check the line and its unit."
    if not seen:
        return f"The seam's line does not run along an edge of the part: {where} it meets no two walls within 4 mm."
    opens, outside = float(np.median(seen)), OPENINGS_DEG["butt"][1]
    advice = " An outside corner as wide as this cannot be welded: weld its inside." if opens > outside else ""
    return (
        f"The line does not run along a {joint} joint: the free space {where} opens {opens:.0f} deg, and a"
        f" {joint} has {low:.0f} to {high:.0f} deg.{advice}"
    )


def _filled(values: Floats, good: npt.NDArray[np.bool_], s: npt.NDArray[np.int64]) -> Floats:
    return np.column_stack([np.interp(s, s[good], values[good, k]) for k in range(3)])


def _smoothed(values: Floats, closed: bool, t: Floats) -> Floats:
    """Return the values along the seam without the facets of its mesh; each leg between corners by itself."""
    turn = np.arccos(np.clip(np.sum(t[1:] * t[:-1], axis=1), -1.0, 1.0))
    cuts = np.flatnonzero(turn > _CORNER_RAD) + 1
    if closed and not len(cuts):
        once = gaussian_filter1d(values[:-1], _SMOOTH_M / SPACING_M, axis=0, mode="wrap")
        return np.vstack([once, once[:1]])
    pieces = []
    for part in np.split(values, cuts):
        pad = min(len(part) - 1, math.ceil(4.0 * _SMOOTH_M / SPACING_M))
        if pad < 1:
            pieces.append(part)
            continue
        # Turned about its ends, so that a slope goes on and the ends are not drawn inwards.
        before, after = 2.0 * part[0] - part[pad:0:-1], 2.0 * part[-1] - part[-2 : -2 - pad : -1]
        long = np.concatenate([before, part, after])
        pieces.append(gaussian_filter1d(long, _SMOOTH_M / SPACING_M, axis=0)[pad : pad + len(part)])
    return np.concatenate(pieces)


def _across(t: Floats) -> Floats:
    z = np.array([0.0, 0.0, 1.0]) if abs(t[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    v = z - (z @ t) * t
    return np.asarray(v / np.linalg.norm(v))


def _across_each(t: Floats) -> Floats:
    return np.stack([_across(row) for row in t])


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))
