"""Nuts, tacks and clamps near a seam, scanned by a ray caster of its own: whether the tool would touch them, by their
geometry.

``python -m tests.welding.seam.obstacles COUNT`` prints how many are touched and accepted, and how many are refused
without need.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from tests.welding.locate.lying import FLOOR, TABLE, Box, Solid, Tube, box, looking, pose, put, scan, triangles
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import WELDING, load_tool
from weldcal.welding.seam.clearance import NoClearance, check_beside
from weldcal.welding.seam.curve import SeamCurve

Array = NDArray[np.float64]

KINDS = ("nut", "tack", "clamp", "none")
TOOL = load_tool(WELDING).tool
CLEAR_M = 0.005  # a thing that stays so far from the tool needs no refusal
UP = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)
HIGH_M = np.sqrt(2.0) * TOOL.tip_radius_m  # of the ball's centre above the root of a right angle


class Found(NamedTuple):
    """One scene: the kind of the thing, its least distance m from the tool (infinite: there is none), and what the
    check says."""

    kind: str
    away_m: float
    refusal: str


def thing(kind: str, rng: np.random.Generator, half_m: float, top_m: float, side_m: float) -> Solid:
    """A thing within 40 mm of a seam along x at y = side_m, z = top_m, -half_m < x < half_m."""
    x, beside = rng.uniform(-half_m, half_m), rng.uniform(0.0, 0.04)
    if kind == "tack":
        size = rng.uniform(0.003, 0.005)
        return Box(
            pose((x, side_m + 0.5 * size, top_m + 0.5 * size)),
            np.array([rng.uniform(0.004, 0.01), 0.5 * size, 0.5 * size]),
        )
    if kind == "nut":
        r, h = rng.uniform((0.006, 0.006), (0.012, 0.014))
        return Tube(pose((x, side_m + r + beside, top_m + 0.5 * h)), r, 0.4 * r, 0.5 * h)
    size, h = rng.uniform((0.015, 0.03), (0.03, 0.08))
    return Box(
        pose((x, side_m + 0.5 * size + beside, top_m + 0.5 * h), (0.0, 0.0, rng.uniform(0.0, 0.3))),
        np.array([0.4 * size, 0.4 * size, 0.5 * h]),
    )


def away(solid: Solid, tool: WeldingTool, root: Array, half_m: float) -> float:
    """Least distance m between a thing's surface and the tool, as its tip runs over a straight seam along x and rises
    at its ends."""
    p = TriMesh(*triangles([solid])).sample(3000, np.random.default_rng(1))[0]
    y = np.cross(UP, [1.0, 0.0, 0.0])
    held = np.column_stack([[1.0, 0.0, 0.0], y, UP])
    X_TF = tool.X_FT.inverse()
    lines = [(np.zeros(3), np.array([0.0, 0.0, 0.03]), tool.tip_radius_m)]
    wire = np.array([-tool.chord_m, 0.0, tool.torch_height_m])
    lines.append((wire, wire + np.array([0.0, 0.0, 0.03]), 0.0006))
    for capsule in tool.capsules():
        a, b = (np.asarray(X_TF.multiply(np.asarray(end))) for end in (capsule.p_start, capsule.p_end))
        share = np.linspace(0.0, 1.0, 40)[:, None]
        kept = (a + share * (b - a))[(a + share * (b - a))[:, 2] > 0.03]
        if len(kept) > 1:
            lines.append((kept[0], kept[-1], float(capsule.radius)))
    places = [(s, 0.0) for s in np.arange(-half_m, half_m + tool.chord_m, 0.002)]
    places += [(s, lift) for s in (-half_m, half_m + tool.chord_m) for lift in np.arange(0.0, 0.09, 0.002)]
    least = np.inf
    for s, lift in places:
        q = (p - root - [s, 0.0, 0.0] - (HIGH_M + lift) * UP) @ held
        for a, b, radius in lines:
            d = b - a
            t = np.clip((q - a) @ d / (d @ d), 0.0, 1.0)
            least = min(least, float(np.sqrt(np.square(q - a - t[:, None] * d).sum(axis=1).min())) - radius)
    return least


def scene(seed: int) -> Found:
    """Draw, scan and check one scene."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    thick, web, high = rng.uniform((0.003, 0.004, 0.05), (0.010, 0.008, 0.09))
    part = [box((-0.16, 0.16), (-0.07, 0.09), (0.0, thick)), box((-0.15, 0.15), (-web, 0.0), (thick, thick + high))]
    half, root = 0.1, np.array([0.0, 0.0, thick])
    other = None if kind == "none" else thing(kind, rng, half, thick, 0.0)
    X = pose((0.6, rng.uniform(-0.05, 0.05), 0.0), (0.0, 0.0, rng.uniform(-3.0, 3.0)))
    at = X[:3, :3] @ np.array([rng.uniform(-0.1, 0.1), rng.uniform(0.2, 0.45), 0.85]) + X[:3, 3]
    cloud = scan([*put([*part, *([] if other is None else [other])], X), TABLE, FLOOR], looking(at, X[:3, 3]), rng)
    points = cloud.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    X_BP = RigidTransform(X)
    line = root + HIGH_M * UP + np.outer(np.linspace(-half, half + TOOL.chord_m, 80), [1.0, 0.0, 0.0])
    seam = SeamCurve.from_points(line, up=UP, length=2.0 * half).transformed(X_BP)
    try:
        check_beside(points, TriMesh(*triangles(part)), X_BP, seam, TOOL)
        refusal = ""
    except NoClearance as error:
        refusal = str(error)
    return Found(kind, np.inf if other is None else away(other, TOOL, root, half), refusal)


def main(count: int) -> int:
    """Print the counts of these scenes; the number of touched things that were accepted."""
    counts: Counter[str] = Counter()
    for seed in range(6000, 6000 + count):
        found = scene(seed)
        state = "touched" if found.away_m < 0.0 else "clear" if found.away_m > CLEAR_M else "near"
        said = "refused" if found.refusal else "accepted"
        counts[f"{found.kind:6} {state:8} {said}"] += 1
        if (state, said) in (("touched", "accepted"), ("clear", "refused")):
            sys.stdout.write(f"{seed} {found}\n")
    for words, n in sorted(counts.items()):
        sys.stdout.write(f"{words:26} {n}\n")
    return sum(n for words, n in counts.items() if "touched" in words and "accepted" in words)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
