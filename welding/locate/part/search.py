"""Finds rough poses of a part in a scan by its silhouettes from above and its heights.

The part is turned into every direction in which it can rest and every angle about the vertical. Its silhouette is
correlated with the cells in which the scan shows something above the ground; at the best shifts the heights are
compared, up to a common lift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix
from scipy import fft

from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.result import PartConfig
from weldcal.welding.locate.part.scan import Plane, PreparedScan

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MOST_CELLS = 150  # along a side of the scene's map
SAME_HEIGHT_M = 0.007  # two heights in one cell: a face that leans by 60 deg rises by 7 mm over a cell of 4 mm
RING_CELLS, RING_SHARE = 3, 0.5
PEAKS, MOST_PLACES, MOST_UPS = 3, (24, 16, 4), 4
LEAST_KNOWN = 0.3  # least share of a covered part that the scan shows
# Plane.filled of a ground: 1 for a square, 0.79 for a disc; less where a plane cuts across several things.
LEAST_FILLED = 0.4
LARGE_M = 0.4  # radius of a part that fills the field of one scan, 0.8 m across
# Extent of a large part's ground, in the scan's: no table is GROUND_EXTENT times as large in the scan.
GROUND_SHARE = 0.85
WIDE_CELLS = 3.0  # in config.cell_m: 12 mm, in which a web and the plate beside it share a cell
RADIUS_CELLS, TURN_CELLS = 40, 1.8  # of a large part: cells along its radius, and of a turn at its ends
# Gates of a large part, in its radius: the second is half a turn and half a cell's diagonal, (0.5 * 1.8 + 0.71) / 40.
LARGE_GATES = (0.053, 0.04)
# A rough place is off by less than a cell of the search, 8 mm: a part whose middle is deeper lies in its ground.
SUNK_M, LEAST_GROUND = 0.008, 30  # depth of a part's middle in its ground, and the coarse points that show this ground
GROUND_EXTENT = 2.6  # extent of the largest plane, in the part's radius, above which it is no face of the part
# A large part does not reach farther through its ground, in its radius; else a beam on end fits wherever a beam lies.
UNDER, LEVEL_GROUND_COS = 0.25, math.cos(math.radians(7.0))
_BOX = {n: np.ones((n, n), np.uint8) for n in (1, 3, 2 * RING_CELLS + 1)}


@dataclass(frozen=True, eq=False)
class RoughPose:
    """A rough pose and its score, 1 for a perfect match; covered: judged by what nothing above the part hides."""

    score: float
    X_BP: RigidTransform
    covered: bool = False


def frame_with_z(z: Floats) -> Floats:
    """A rotation (3,3) whose third column is z."""
    x = np.cross(np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0]), z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def rough_places(scan: PreparedScan, model: PartModel, config: PartConfig) -> list[RoughPose]:
    """Rough poses of the part in the scan, best first: at most MOST_PLACES of each kind."""
    ups: list[tuple[Floats, Plane | None]] = []
    large = grounds(scan, model)
    for plane in [*large, *scan.planes]:
        # The part lies on a large plane, a tilted positioner's too, or a smaller plane is a face of the part.
        is_ground = plane in large
        known = [g for u, g in ups if float(plane.normal @ u) > math.cos(math.radians(7.0))]
        if not is_ground and ups and float(plane.normal @ ups[0][0]) < math.cos(math.radians(50.0)):
            continue
        if is_ground:
            known = [g for g in known if g is plane or g is None or abs(g.level - plane.level) < SAME_HEIGHT_M]
        if len(ups) < MOST_UPS and not known:
            ups.append((plane.normal, plane if is_ground else large[0] if large else None))
    places: list[RoughPose] = []
    for k, (up, ground) in enumerate(ups or [(np.array([0.0, 0.0, 1.0]), None)]):
        places += _places_for(scan, model, config, up, config.turn_step_rad * (1.0 if k == 0 else 1.5), ground)
    places.sort(key=lambda place: -place.score)
    # 2: the part would stick in its ground; 1: something covers it; 0: neither.
    kinds = [2 if sinks(scan, model, p.X_BP) else int(p.covered) for p in places]
    kept: list[RoughPose] = []
    for kind, more in enumerate(MOST_PLACES):
        most = len(kept) + more
        for place in (p for p, k in zip(places, kinds, strict=True) if k == kind):
            if len(kept) == most:
                break
            if not any(_near(place.X_BP, other.X_BP, model) for other in kept):
                kept.append(place)
    return kept


def grounds(scan: PreparedScan, model: PartModel) -> list[Plane]:
    """The planes on which the part may lie: too large to be its own faces."""
    least = GROUND_EXTENT * model.radius
    if model.radius > LARGE_M:
        least = min(least, GROUND_SHARE * scan.extent_m)
    return [p for p in scan.planes if p.extent_m > least and p.filled > LEAST_FILLED]


def sinks(scan: PreparedScan, model: PartModel, X_BP: RigidTransform) -> bool:
    """Whether the part would stick in its ground, its middle beneath a plane that it meets and that is shown there."""
    middle, points = X_BP.multiply(model.center), X_BP.multiply(model.points[::30].T).T
    for plane, shown in zip(scan.planes, scan.shown, strict=True):
        if plane.extent_m < GROUND_EXTENT * model.radius or plane.filled < LEAST_FILLED:
            continue
        depth = plane.level - float(middle @ plane.normal)
        if depth < SUNK_M or (points @ plane.normal).max() < plane.level - SAME_HEIGHT_M:
            continue
        if shown.query_ball_point(middle + depth * plane.normal, model.radius, return_length=True) > LEAST_GROUND:
            return True
    return False


def _near(A: RigidTransform, B: RigidTransform, model: PartModel) -> bool:
    turn = math.acos(
        max(-1.0, min(1.0, 0.5 * (float(np.trace(A.rotation().matrix().T @ B.rotation().matrix())) - 1.0)))
    )
    away = float(np.linalg.norm(A.multiply(model.center) - B.multiply(model.center)))
    return turn < math.radians(9.0) and away < 0.009


def _places_for(
    scan: PreparedScan, model: PartModel, config: PartConfig, up: Floats, step: float, ground: Plane | None
) -> list[RoughPose]:
    """Places with one direction of the base up."""
    R_BU = frame_with_z(up)
    q = scan.coarse @ R_BU
    low, high = np.percentile(q[:, :2], 0.5, axis=0), np.percentile(q[:, :2], 99.5, axis=0)
    cell = max(config.cell_m, float((high - low).max()) / MOST_CELLS, model.radius / RADIUS_CELLS)
    step = min(step, max(TURN_CELLS * cell / model.radius, math.radians(2.0)))
    reach = math.ceil(1.02 * model.radius / cell) + RING_CELLS + 1
    corner = low - reach * cell
    size = np.ceil((high - low) / cell).astype(int) + 2 * reach + 1
    full = [fft.next_fast_len(int(size[1]), real=True), fft.next_fast_len(int(size[0]), real=True)]
    i = ((q[:, :2] - corner) / cell).astype(np.int64)
    inside = ((q[:, :2] > low) & (q[:, :2] < high)).all(axis=1)
    above = np.full(len(q), True) if ground is None else scan.coarse @ ground.normal - ground.level > ground.own_m
    top = np.full((size[1], size[0]), np.nan, dtype=np.float32)
    known = np.zeros(top.shape, dtype=bool)
    known[i[inside, 1], i[inside, 0]] = True
    order = np.flatnonzero(inside & above)
    order = order[np.argsort(q[order, 2])]
    top[i[order, 1], i[order, 0]] = q[order, 2]  # the highest is written last
    body_seen = np.isfinite(top)
    # In the wide cells of a large part a web may lie in the next cell: heights are compared with those around.
    around = _BOX[3] if cell > WIDE_CELLS * config.cell_m else _BOX[1]
    known_ground = known & ~body_seen
    everything = _scene(top, known_ground, around, full, False)
    places: list[RoughPose] = []
    points, normals = model.points - model.center, model.normals
    level_ground = ground is not None and float(ground.normal @ up) > LEVEL_GROUND_COS and model.radius > LARGE_M
    under = ground.level - UNDER * model.radius if ground is not None and level_ground else -math.inf
    for direction in model.directions:
        R_UP = frame_with_z(direction).T  # turns `direction` into z
        p = points @ R_UP.T
        lowest_z = float(p[:, 2].min())
        scenes = [everything]
        if ground is not None and ground.normal is up:
            # What is higher than the part, if it lies on the ground, hides it: there the scan says nothing about it.
            ceiling = ground.level + float(np.ptp(p[:, 2])) + SAME_HEIGHT_M
            above_part = body_seen & (np.nan_to_num(top) > ceiling)
            if above_part.any():
                scenes.append(_scene(np.where(above_part, np.nan, top), known_ground, around, full, True))
        p = p[normals @ R_UP.T[:, 2] > 0.05]
        p = p[np.argsort(p[:, 2])]
        for turn in np.arange(0.0, 2.0 * math.pi, step):
            c, s = math.cos(turn), math.sin(turn)
            j = np.floor(p[:, :2] @ np.array([[c, s], [-s, c]]) / cell + 0.5).astype(np.int64) + reach
            shape = np.full((2 * reach + 1, 2 * reach + 1), np.nan, dtype=np.float32)
            shape[j[:, 1], j[:, 0]] = p[:, 2]
            body = np.isfinite(shape)
            ring = cv2.dilate(body.astype(np.uint8), _BOX[2 * RING_CELLS + 1]).astype(bool)
            ring &= ~cv2.dilate(body.astype(np.uint8), _BOX[3]).astype(bool)
            n = float(body.sum())
            f_body = fft.rfft2(body.astype(np.float32) / np.float32(n), s=full)
            f_ring = fft.rfft2(ring.astype(np.float32) * np.float32(RING_SHARE / max(1, int(ring.sum()))), s=full)
            for scene in scenes:
                match = fft.irfft2(scene.body * np.conj(f_body) - scene.shown * np.conj(f_ring), s=full)
                match = match[: size[1] - 2 * reach, : size[0] - 2 * reach]
                rows, columns = np.nonzero(body)
                heights = shape[rows, columns]
                best = 0.0
                for _ in range(PEAKS):
                    _, value, _, (column, row) = cv2.minMaxLoc(match)
                    if value < max(0.1, 0.5 * best):
                        break
                    best = max(best, value)
                    cv2.circle(match, (column, row), 3, -1.0, -1)
                    at = (row + rows, column + columns)
                    difference = scene.top[at] - heights
                    shown = np.isfinite(difference)
                    difference = difference[shown]
                    if len(difference) < 0.2 * n:
                        continue
                    lift = float(np.median(difference))
                    if lift + lowest_z < under:
                        continue
                    below, above_it = (
                        limit[at][shown] - heights[shown] - lift for limit in (scene.lowest, scene.highest)
                    )
                    same = (below < SAME_HEIGHT_M) & (above_it > -SAME_HEIGHT_M)
                    score = float(value) - float(len(difference) - np.count_nonzero(same)) / n
                    if scene.covered:
                        score /= max(LEAST_KNOWN, float(np.mean(shown | known_ground[at])))
                    middle = corner + (np.array([column, row]) + reach + 0.5) * cell
                    R = R_BU @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_UP
                    level = (
                        np.abs(difference - lift) < SAME_HEIGHT_M
                    )  # a web in the next cell does not count for the lift
                    lift = float(np.mean(difference[level])) if level.any() else lift
                    origin = R_BU @ np.array([middle[0], middle[1], lift]) - R @ model.center
                    X = RigidTransform(RotationMatrix(_orthogonal(R)), origin)
                    places.append(RoughPose(score, X, scene.covered))
    places.sort(key=lambda place: -place.score)
    return [p for p in places if not p.covered][:400] + [p for p in places if p.covered][:400]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scene:
    """What the search compares: heights (H,W), NaN for none, their limits around a cell, and the masks' transforms."""

    top: npt.NDArray[np.floating]
    lowest: npt.NDArray[Any]
    highest: npt.NDArray[Any]
    body: npt.NDArray[np.complexfloating]
    shown: npt.NDArray[np.complexfloating]
    covered: bool


def _scene(
    top: npt.NDArray[np.floating], empty: Mask, around: npt.NDArray[np.uint8], full: list[int], covered: bool
) -> _Scene:
    """The scene of heights, with the cells in which only the ground is shown."""
    body = np.isfinite(top)
    return _Scene(
        top=top,
        lowest=cv2.erode(np.where(body, top, np.float32(np.inf)), around),
        highest=cv2.dilate(np.where(body, top, np.float32(-np.inf)), around),
        body=fft.rfft2(body.astype(np.float32) - empty.astype(np.float32), s=full),
        shown=fft.rfft2(body.astype(np.float32), s=full),
        covered=covered,
    )


def _orthogonal(R: Floats) -> Floats:
    u, _, v = np.linalg.svd(R)
    return np.asarray(u @ v)
