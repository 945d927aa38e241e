"""Searches a cloud for grooves to a pixel or two: cells below a flat face, with face on both sides, joined to lines."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydrake.math import RigidTransform
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from weldcal.welding.locate.planes import Floats, Mask, into, point_pitch, robust_plane, upward_planes


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Thresholds for a face and for a groove in it; metres and radians.

    Attributes:
        max_width_m: wider openings are not grooves.
        shortest_m: shorter openings are not grooves.
        max_depth_m: of the groove.
        max_gap_m: two pieces that continue each other across at most this, with no face seen between them, are one
            groove.
        steepest_rad: largest tilt of the face from the up direction.
    """

    max_width_m: float = 0.020
    max_depth_m: float = 0.030
    shortest_m: float = 0.030
    max_gap_m: float = 0.090
    least_face_m2: float = 0.0015
    steepest_rad: float = math.radians(30.0)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class CoarseGroove:
    """A groove's centre line (N,2) m in the face's frame Q, spaced 1 mm, X_AQ of that face in the cloud's frame.

    Attributes:
        sigma_m, pitch_m: the noise of the face's points about it, and the distance between them.
        width_m: of the opening.
    """

    X_AQ: RigidTransform
    line_Q: Floats
    closed: bool
    width_m: float
    sigma_m: float
    pitch_m: float


def find_grooves(points: Floats, config: SearchConfig) -> tuple[list[CoarseGroove], float, float]:
    """Find every groove-like opening in faces of a cloud (N,3) m whose z is up.

    The largest noise and the widest distance of points on the faces seen, m.
    """
    rng = np.random.default_rng(config.seed)
    sample = points[rng.choice(len(points), size=min(len(points), 12000), replace=False)]
    center = np.array([*np.median(sample, axis=0)])
    found: list[CoarseGroove] = []
    noise = widest = 0.0
    for X in upward_planes(sample - center, config.steepest_rad, 120, rng, most=6):
        X_AQ = RigidTransform(center) @ X
        here, noise_here, pitch = _in_plane(points, X_AQ, config)
        found += here
        noise, widest = max(noise, noise_here), max(widest, pitch)
    return _distinct(found), noise, widest


def _distinct(found: list[CoarseGroove]) -> list[CoarseGroove]:
    """The grooves without those found again in a second plane through the same face."""
    kept: list[CoarseGroove] = []
    for groove in sorted(found, key=lambda g: -len(g.line_Q)):
        middle = _lifted(groove)[len(groove.line_Q) // 2]
        if all(np.linalg.norm(_lifted(k) - middle, axis=1).min() > groove.width_m for k in kept):
            kept.append(groove)
    return kept


def _lifted(groove: CoarseGroove) -> Floats:
    line = np.column_stack([groove.line_Q, np.zeros(len(groove.line_Q))])
    return np.asarray(line @ groove.X_AQ.rotation().matrix().T + groove.X_AQ.translation())


def _in_plane(points: Floats, X_AQ: RigidTransform, config: SearchConfig) -> tuple[list[CoarseGroove], float, float]:
    """The grooves of all faces in one plane, the noise of the noisiest and the distance of points, m."""
    q = into(X_AQ, points)
    q = q[(q[:, 2] > -0.15) & (q[:, 2] < 0.006)]
    on = np.abs(q[:, 2]) < 0.003
    if np.count_nonzero(on) < 300:
        return [], 0.0, 0.0
    pitch = point_pitch(q[on][:, :2])
    cell = 1.25 * pitch
    corner = q[:, :2].min(axis=0) - 6.0 * cell
    width, height = (np.ceil((q[:, :2].max(axis=0) - corner) / cell).astype(int) + 6).tolist()
    index = ((q[:, :2] - corner) / cell).astype(np.int64)
    face, below, level = np.zeros((3, height, width), dtype=np.uint8)
    face[index[on, 1], index[on, 0]] = 1
    solid = cv2.morphologyEx(face, cv2.MORPH_CLOSE, _disc(3))
    across = max(3, math.ceil(config.max_width_m / cell)) | 1
    bridged = cv2.morphologyEx(solid, cv2.MORPH_OPEN, _disc(5))
    bridged = cv2.morphologyEx(cv2.morphologyEx(bridged, cv2.MORPH_CLOSE, _disc(across)), cv2.MORPH_OPEN, _disc(across))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bridged)
    label_of = labels[index[:, 1], index[:, 0]]
    noise = 0.0
    for label in range(1, count):
        mine = label_of == label
        if stats[label, cv2.CC_STAT_AREA] * cell**2 < config.least_face_m2 or np.count_nonzero(mine & on) < 300:
            continue
        at, f = index[mine], q[mine]
        X_QF, sigma = _thinned_plane(f[np.abs(f[:, 2]) < 0.003])
        f = into(X_QF, f)
        noise = max(noise, sigma)
        low = f[:, 2] < -max(4.0 * sigma, 0.0008)
        opening = np.zeros((height, width), dtype=np.uint8)
        deep = low & (f[:, 2] > -config.max_depth_m)
        opening[at[deep, 1], at[deep, 0]] = 1
        level[at[~low, 1], at[~low, 0]] = 1
        inside = cv2.erode((labels == label).astype(np.uint8), _disc(5))
        opening = cv2.morphologyEx(cv2.bitwise_and(opening, inside), cv2.MORPH_CLOSE, _disc(5))
        below = cv2.bitwise_or(below, cv2.bitwise_and(opening, inside))
    # Lower ground outside every face ends a groove as a face does.
    ground = (label_of == 0) & (q[:, 2] < -0.004)
    level[index[ground, 1], index[ground, 0]] = 1
    found = []
    for line, closed, opening_m in _lines(below.astype(bool), level.astype(bool), cell, config):
        xy = line * cell + corner + 0.5 * cell
        beside = np.asarray(cKDTree(xy[::3]).query(q[on][:, :2], distance_upper_bound=0.02)[0])
        near = q[on][np.isfinite(beside)]
        if len(near) < 200:
            continue
        X_QF, sigma = _thinned_plane(near)
        in_face = into(X_QF, np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
        found.append(CoarseGroove(X_AQ @ X_QF, in_face, closed, opening_m, sigma, pitch))
    return found, noise, pitch if noise > 0.0 else 0.0


def _thinned_plane(q: Floats) -> tuple[RigidTransform, float]:
    """The face through points (N,3), and their noise about it."""
    some = q[:: max(1, len(q) // 20000)]
    X_QF, sigma = robust_plane(some)
    z = into(X_QF, some)[:, 2]
    return X_QF, 1.4826 * float(np.median(np.abs(z[np.abs(z) < max(0.003, 4.0 * sigma)])))


def _disc(size: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


def _lines(below: Mask, level: Mask, cell: float, config: SearchConfig) -> list[tuple[Floats, bool, float]]:
    """Centre lines (N,2) in cells spaced 1 mm, whether closed, and the opening's width m, of the grooves in a mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(below.astype(np.uint8))
    pieces: list[tuple[Floats, bool, int]] = []
    for label in range(1, count):
        extent = cell * math.hypot(stats[label, cv2.CC_STAT_WIDTH], stats[label, cv2.CC_STAT_HEIGHT])
        if extent < 0.008 or stats[label, cv2.CC_STAT_AREA] < 12:
            continue
        line, closed = _centre_line(labels == label)
        if len(line) >= 4:
            pieces.append((line, closed, int(stats[label, cv2.CC_STAT_AREA])))
    joined = _joined([p for p in pieces if not p[1]], level, cell, config) + [p for p in pieces if p[1]]
    out = []
    for line, closed, area in joined:
        line = _even(line, 0.001 / cell, closed)
        line = _even(_smooth(line, 4.0, closed), 0.001 / cell, closed)
        length = 0.001 * len(line)
        width = area * cell**2 / length
        if length >= config.shortest_m and width < min(0.4 * length, 1.5 * config.max_width_m):
            out.append((line, closed, width))
    return out


def _centre_line(mask: Mask) -> tuple[Floats, bool]:
    """The line through the middle of a mask's cells between its two farthest ends, (N,2) as (x, y) cells; or a loop."""
    rows, columns = np.nonzero(mask)
    number = np.full(mask.shape, -1)
    number[rows, columns] = np.arange(len(rows))
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1][rows, columns]
    dear = 1.0 + 4.0 * np.square(np.maximum(float(depth.max()) - depth, 0.0))
    ends: list[np.ndarray] = [np.empty(0, dtype=np.int64)] * 2
    steps: list[Floats] = []
    starts, stops = [], []
    padded = np.pad(number, 1, constant_values=-1)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        neighbour = padded[rows + 1 + dy, columns + 1 + dx]
        some = neighbour >= 0
        starts.append(np.flatnonzero(some))
        stops.append(neighbour[some])
        steps.append(np.full(np.count_nonzero(some), math.hypot(dx, dy)))
    ends = [np.concatenate(starts), np.concatenate(stops)]
    step = np.concatenate(steps)
    shape = (len(rows), len(rows))

    def graph(cost: Floats, keep: Mask) -> Any:
        some = keep[ends[0]] & keep[ends[1]]
        a, b = ends[0][some], ends[1][some]
        return csr_array((step[some] * 0.5 * (cost[a] + cost[b]), (a, b)), shape=shape)

    shortest: Any = dijkstra
    everything = np.ones(len(rows), dtype=bool)
    plain = graph(np.ones(len(rows)), everything)
    first = int(np.argmax(_finite(shortest(plain, directed=False, indices=0))))
    last = int(np.argmax(_finite(shortest(plain, directed=False, indices=first))))
    xy = np.column_stack([columns, rows]).astype(np.float64)

    def way(keep: Mask) -> list[int]:
        _, before = shortest(graph(dear, keep), directed=False, indices=first, return_predecessors=True)
        path = [last]
        while path[-1] != first and before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        return path[::-1] if path[-1] == first else []

    out = way(everything)
    if not out:
        return np.empty((0, 2)), False
    # A ring has a second path between its two farthest points that stays away from the first.
    margin = 2.0 * float(depth.max()) + 1.0
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy[out], axis=0), axis=1))])
    middle = xy[out][(along > 2.0 * margin) & (along < along[-1] - 2.0 * margin)]
    if len(middle):
        gap = np.min(np.linalg.norm(xy[:, None] - middle[None, ::3], axis=2), axis=1)
        second = way(gap > margin)
        if second:
            # Both paths run into the corners of the opening at their ends: there the ring is closed straight across.
            return np.vstack([_trimmed(xy[out], margin), _trimmed(xy[second[::-1]], margin)]), True
    return xy[out], False


def _trimmed(line: Floats, margin: float) -> Floats:
    """A line (N,2) without its first and last stretch."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return np.asarray(line[(along >= margin) & (along <= along[-1] - margin)])


def _finite(distance: Floats) -> Floats:
    return np.where(np.isfinite(distance), distance, -1.0)


def _joined(
    pieces: list[tuple[Floats, bool, int]], level: Mask, cell: float, config: SearchConfig
) -> list[tuple[Floats, bool, int]]:
    """Join pieces that continue each other, with no face seen between them, by a smooth bridge."""
    pieces = list(pieces)
    while len(pieces) > 1:
        best: tuple[float, int, int, Floats] | None = None
        for i in range(len(pieces)):
            for j in range(i):
                for a in (pieces[i][0], pieces[i][0][::-1]):
                    for b in (pieces[j][0], pieces[j][0][::-1]):
                        cost, bridge = _bridge(a, b, level, cell, config)
                        if best is None or cost < best[0]:
                            best = (cost, i, j, np.vstack([a, bridge, b]))
        if best is None or not math.isfinite(best[0]):
            break
        _, i, j, line = best
        rest = [p for k, p in enumerate(pieces) if k not in (i, j)]
        pieces = [*rest, (line, False, pieces[i][2] + pieces[j][2])]
    return pieces


def _bridge(a: Floats, b: Floats, level: Mask, cell: float, config: SearchConfig) -> tuple[float, Floats]:
    """Compute a smooth bridge from the end of one line to the beginning of the other: its cost and its points.

    The cost is infinite where they are two lines.
    """
    none = (math.inf, np.empty((0, 2)))
    gap = b[0] - a[-1]
    distance = float(np.linalg.norm(gap))
    if distance * cell > config.max_gap_m or distance < 1e-9:
        return none
    reach = max(3, round(0.012 / cell))
    out, into_b = a[-1] - a[max(-reach, -len(a))], b[min(reach, len(b)) - 1] - b[0]
    out, into_b = out / np.linalg.norm(out), into_b / np.linalg.norm(into_b)
    ahead = gap / distance
    turn = max(math.acos(np.clip(out @ ahead, -1.0, 1.0)), math.acos(np.clip(into_b @ ahead, -1.0, 1.0)))
    # Over a few cells the directions are noise.
    if turn > math.radians(50.0) and distance * cell > 0.012:
        return none
    t = np.linspace(0.0, 1.0, max(3, round(distance)))[1:-1, None]
    bridge = (
        (2 * t**3 - 3 * t**2 + 1) * a[-1]
        + (t**3 - 2 * t**2 + t) * distance * out
        + (3 * t**2 - 2 * t**3) * b[0]
        + (t**3 - t**2) * distance * into_b
    )
    at = np.clip(np.round(bridge).astype(int), 0, np.array(level.shape[::-1]) - 1)
    if len(at) > 4 and np.mean(level[at[:, 1], at[:, 0]]) > 0.35:
        return none
    return distance * (1.0 + turn), bridge


def _even(line: Floats, spacing: float, closed: bool) -> Floats:
    """A polyline (N,2) resampled evenly; a closed one does not repeat its first point."""
    if closed:
        line = np.vstack([line, line[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, s[-1], max(4, round(s[-1] / spacing) + 1))
    even = np.column_stack([np.interp(at, s, line[:, k]) for k in range(2)])
    return even[:-1] if closed else even


def _smooth(line: Floats, width: float, closed: bool) -> Floats:
    """Gaussian smoothing of a line's points, with the line extended straight beyond open ends."""
    if closed:
        return np.asarray(gaussian_filter1d(line, width, axis=0, mode="wrap"))
    n = min(len(line) - 1, math.ceil(3 * width))
    before, after = 2.0 * line[0] - line[n:0:-1], 2.0 * line[-1] - line[-2 : -n - 2 : -1]
    return np.asarray(gaussian_filter1d(np.vstack([before, line, after]), width, axis=0)[n:-n])
