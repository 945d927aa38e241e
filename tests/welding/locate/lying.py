"""Scenes of parts as they lie in a welding cell, by a ray caster of its own: formulas of boxes and tubes, no mesh.

``python -m tests.welding.locate.lying`` registers the 60 judged scenes. It prints how many poses are right, wrong or
refused.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 720, 540, 850.0
BASELINE_M = 0.22  # from the camera to the projector
SIGMA_M, WAVE_M = 1.0e-4, 0.6e-4  # noise of neighbouring pixels, and smooth distortion
RIGHT_M = 0.001  # largest displacement of a corner of the part that is right
FIXED_SEED, JUDGED_SEED = 7000, 100  # thresholds are fixed on the first, the figure is judged on the second


def pose(p: Sequence[float] = (0.0, 0.0, 0.0), rotvec: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    """A pose (4,4) by a translation m and a rotation vector rad."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    X[:3, 3] = p
    return X


@dataclass(frozen=True)
class Box:
    """A box with its centre at the pose X (4,4), half its sizes, m."""

    X: Array
    half: Array

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.half))

    def hit(self, o: Array, d: Array) -> tuple[Array, Array]:
        """Distances (N,) along rays d (N,3) from o (3,) and normals (N,3), in the box's frame."""
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-self.half - o) / d, (self.half - o) / d
        near, far = np.minimum(a, b), np.maximum(a, b)
        k = np.argmax(near, axis=1)
        t = near[np.arange(len(d)), k]
        n = np.zeros_like(d)
        n[np.arange(len(d)), k] = -np.sign(d[np.arange(len(d)), k])
        return np.where((t <= far.min(axis=1)) & (t > 1e-6), t, np.inf), n

    def triangles(self) -> tuple[Array, NDArray[np.int64]]:
        """Corners (8,3) and triangles (12,3), outwards, in the box's frame."""
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * self.half
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


@dataclass(frozen=True)
class Tube:
    """A tube along z about the pose's origin: outer and inner radius (0: solid) and half the length, m."""

    X: Array
    outer: float
    inner: float
    half: float

    @property
    def reach(self) -> float:
        return math.hypot(self.outer, self.half)

    def hit(self, o: Array, d: Array) -> tuple[Array, Array]:
        """Distances (N,) along rays d (N,3) from o (3,) and normals (N,3), in the tube's frame."""
        best, normal = np.full(len(d), np.inf), np.zeros_like(d)

        def take(t: Array, keep: Array, n: Array) -> None:
            keep = keep & (t > 1e-6) & (t < best)
            best[keep] = t[keep]
            normal[keep] = n[keep]

        a = d[:, 0] ** 2 + d[:, 1] ** 2
        b = o[0] * d[:, 0] + o[1] * d[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            for r, side in ((self.outer, 1.0), (self.inner, -1.0)):
                if r <= 0.0:
                    continue
                root = np.sqrt(b * b - a * (o[0] ** 2 + o[1] ** 2 - r * r))
                for sign in (-1.0, 1.0):
                    t = (-b + sign * root) / a
                    p = o + t[:, None] * d
                    take(t, np.abs(p[:, 2]) <= self.half, side * p * [1.0 / r, 1.0 / r, 0.0])
            for z in (-self.half, self.half):
                t = (z - o[2]) / d[:, 2]
                rho = np.hypot(*(o[k] + t * d[:, k] for k in (0, 1)))
                take(
                    t,
                    (rho <= self.outer) & (rho >= self.inner),
                    np.broadcast_to([0.0, 0.0, float(np.sign(z))], d.shape),
                )
        return best, normal

    def triangles(self) -> tuple[Array, NDArray[np.int64]]:
        """Corners and triangles, outwards, of 64 flat sides, in the frame of a tube that is not solid."""
        n = 64
        angle = 2.0 * np.pi * np.arange(n) / n
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        profile = [(self.outer, -self.half), (self.outer, self.half), (self.inner, self.half), (self.inner, -self.half)]
        corners = np.concatenate([np.column_stack([r * ring, np.full(n, z)]) for r, z in profile])
        faces = []
        for k in range(4):
            low, high = n * k, n * ((k + 1) % 4)
            for i in range(n):
                j = (i + 1) % n
                faces += [(low + i, low + j, high + j), (low + i, high + j, high + i)]
        return corners, np.array(faces)


Solid = Box | Tube


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Box:
    """A box between limits along the axes, m."""
    low, high = np.array([x, y, z]).T
    return Box(pose(0.5 * (low + high)), 0.5 * (high - low))


def put(solids: Sequence[Solid], X: Array) -> list[Solid]:
    """Solids moved by X (4,4)."""
    return [replace(s, X=X @ s.X) for s in solids]


def triangles(solids: Sequence[Solid]) -> tuple[Array, NDArray[np.int64]]:
    """Corners and triangles of all solids, each closed by itself, as a CAD file with several bodies has them."""
    corners, faces, count = [], [], 0
    for s in solids:
        p, f = s.triangles()
        corners.append(p @ s.X[:3, :3].T + s.X[:3, 3])
        faces.append(f + count)
        count += len(p)
    return np.concatenate(corners), np.concatenate(faces)


def first_hit(solids: Sequence[Solid], origin: Array, d: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Distances (N,) along unit rays d (N,3) from origin (3,), the normals (N,3) there, and which solid, -1: none."""
    best, normal, which = np.full(len(d), np.inf), np.zeros_like(d), np.full(len(d), -1)
    for k, s in enumerate(solids):
        to = s.X[:3, 3] - origin
        far = float(np.linalg.norm(to))
        index = (
            np.flatnonzero(d @ (to / far) > math.sqrt(1.0 - (s.reach / far) ** 2) - 1e-9)
            if far > s.reach
            else np.arange(len(d))
        )
        if not len(index):
            continue
        R = s.X[:3, :3]
        t, n = s.hit(R.T @ (origin - s.X[:3, 3]), d[index] @ R)
        closer = t < best[index]
        index = index[closer]
        best[index], normal[index], which[index] = t[closer], n[closer] @ R.T, k
    return best, normal, which


def looking(eye: Array, target: Array, turn: float = 0.0) -> Array:
    """X_BC (4,4) of a camera at eye (3,) that looks at target (3,), turned about its axis."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    X[:3, 3] = eye
    return X


def scan(solids: Sequence[Solid], X_BC: Array, rng: np.random.Generator, shiny: Sequence[int] = ()) -> Array:
    """Simulate a scan (H,W,3) m in the base, NaN where nothing was measured.

    It has noise, shadows of the projector, lost points and flying points.
    The solids whose numbers are in `shiny` return only where they mirror little.
    """
    u, v = np.meshgrid(
        (np.arange(WIDTH) - 0.5 * WIDTH) / FOCAL, (np.arange(HEIGHT) - 0.5 * HEIGHT) / FOCAL, indexing="xy"
    )
    d = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)) @ X_BC[:3, :3].T
    eye, lamp = X_BC[:3, 3], X_BC[:3, 3] + BASELINE_M * X_BC[:3, 0]
    t, n, which = first_hit(solids, eye, d)
    found = np.isfinite(t)
    p = eye + np.where(found, t, 0.0)[:, None] * d
    to = p - lamp
    far = np.linalg.norm(to, axis=1)
    beam = to / far[:, None]
    lit, _, _ = first_hit(solids, lamp, beam)
    cosine = -np.sum(d * n, axis=1)
    found &= (lit > far - 3e-4) & (cosine > 0.17) & (-np.sum(beam * n, axis=1) > 0.12)
    found &= rng.uniform(size=len(t)) < np.clip(4.0 * cosine, 0.0, 0.995)
    if len(shiny):
        # Light that is mirrored into the camera blinds it, and steep faces return nothing.
        half = -(d + beam)
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        glare = np.sum(half * n, axis=1)
        blotch = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 9.0).ravel()
        found &= ~(np.isin(which, shiny) & ((glare > 0.997) | (blotch > 0.8 * blotch.std())))
    wave = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 60.0)
    noise = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 0.7)
    error = (WAVE_M * wave / wave.std() + SIGMA_M * noise / noise.std()).ravel()
    depth = np.where(found, t, np.nan).reshape(HEIGHT, WIDTH)
    low, high = minimum_filter(np.nan_to_num(depth, nan=9.0), 3), maximum_filter(np.nan_to_num(depth, nan=0.0), 3)
    step = (high - low > 0.006) & np.isfinite(depth) & (low < 8.0)
    chance = rng.uniform(size=depth.shape)
    depth = np.where(step & (chance < 0.06), low + rng.uniform(size=depth.shape) * (high - low), depth)
    depth = np.where(step & (chance > 0.6), np.nan, depth)
    return np.asarray((eye + (depth.ravel() + error)[:, None] * d).reshape(HEIGHT, WIDTH, 3))


# --- parts, in their frame P


def sheet_with_web(rng: np.random.Generator, thickness: float | None = None) -> list[Solid]:
    """A base sheet of 0.8 to 3 mm with a web off its middle, and a gusset."""
    t = rng.uniform(0.0008, 0.003) if thickness is None else thickness
    a, b = rng.uniform(0.20, 0.30), rng.uniform(0.12, 0.18)
    w, h = rng.uniform(0.0015, 0.005), rng.uniform(0.03, 0.07)
    y, x0, x1 = rng.uniform(0.1, 0.25) * b, -rng.uniform(0.30, 0.45) * a, rng.uniform(0.15, 0.28) * a
    g = rng.uniform(0.02, 0.03)
    return [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, t)),
        box((x0, x1), (y, y + w), (t, t + h)),
        box((x0 + 0.02, x0 + 0.02 + w), (y - g, y), (t, t + 0.7 * h)),
    ]


def flat_sheet(rng: np.random.Generator) -> list[Solid]:
    """A flat sheet of 0.8 to 3 mm with an outline that no turn maps to itself, as two or three pieces butted."""
    t = rng.uniform(0.0008, 0.003)
    a, b, c, e = rng.uniform(0.18, 0.28), rng.uniform(0.06, 0.09), rng.uniform(0.06, 0.12), rng.uniform(0.05, 0.08)
    return [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, t)),
        box((-a / 2, -a / 2 + e), (b / 2, b / 2 + c), (0, t)),
        box((0.1 * a, 0.1 * a + 0.03), (-b / 2 - 0.035, -b / 2), (0, t)),
    ]


def bracket(rng: np.random.Generator) -> list[Solid]:
    """A bracket of plates: base, back and a gusset off the middle."""
    t = rng.uniform(0.004, 0.010)
    a, b, h = rng.uniform(0.12, 0.20), rng.uniform(0.09, 0.14), rng.uniform(0.06, 0.11)
    g = rng.uniform(0.1, 0.25) * a
    return [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, t)),
        box((-a / 2, a / 2), (b / 2 - t, b / 2), (t, h)),
        box((g, g + t), (-b / 6, b / 2 - t), (t, 0.6 * h)),
    ]


def frame(rng: np.random.Generator) -> list[Solid]:
    """A frame of four square tubes and a post off its middle."""
    s, a, b = rng.uniform(0.025, 0.04), rng.uniform(0.22, 0.30), rng.uniform(0.16, 0.20)
    x = rng.uniform(0.1, 0.3) * a
    return [
        box((-a / 2, a / 2), (-b / 2, -b / 2 + s), (0, s)),
        box((-a / 2, a / 2), (b / 2 - s, b / 2), (0, s)),
        box((-a / 2, -a / 2 + s), (-b / 2 + s, b / 2 - s), (0, s)),
        box((a / 2 - s, a / 2), (-b / 2 + s, b / 2 - s), (0, s)),
        box((x, x + s), (b / 2 - s, b / 2), (s, s + rng.uniform(0.05, 0.09))),
    ]


def tube_on_plate(rng: np.random.Generator) -> list[Solid]:
    """A plate with a tube off its middle and a lug."""
    t, a, b = rng.uniform(0.003, 0.008), rng.uniform(0.18, 0.24), rng.uniform(0.12, 0.16)
    r, h = rng.uniform(0.02, 0.035), rng.uniform(0.04, 0.09)
    x = rng.uniform(0.12, 0.22) * a
    return [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, t)),
        Tube(pose((-x, 0.012, t + h / 2)), r, r - 0.004, h / 2),
        box((0.25 * a, 0.25 * a + 0.012), (-0.3 * b, 0.1 * b), (t, t + 0.03)),
    ]


def nearly_symmetric(rng: np.random.Generator) -> list[Solid]:
    """A plate with a web along its middle: only a small lug differs after a turn by 180 degrees."""
    t, a, b = rng.uniform(0.002, 0.006), rng.uniform(0.2, 0.26), rng.uniform(0.1, 0.14)
    w, h = rng.uniform(0.004, 0.006), rng.uniform(0.035, 0.05)
    c = rng.uniform(0.014, 0.022)
    return [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, t)),
        box((-a / 2, a / 2), (-w / 2, w / 2), (t, t + h)),
        box((0.3 * a, 0.3 * a + c), (w / 2, w / 2 + c), (t, t + 0.010)),
    ]


def beam(rng: np.random.Generator) -> list[Solid]:
    """A beam of 1.5 m: flange, web, and stiffeners at unequal distances."""
    a, b, h = 1.5, rng.uniform(0.10, 0.14), rng.uniform(0.08, 0.12)
    solids: list[Solid] = [
        box((-a / 2, a / 2), (-b / 2, b / 2), (0, 0.008)),
        box((-a / 2, a / 2), (-0.003, 0.003), (0.008, h)),
    ]
    for x in (-0.62, -0.31, 0.06, 0.47):
        side = 1.0 if rng.uniform() < 0.5 else -1.0
        y = sorted((side * 0.003, side * 0.45 * b))
        at = x + rng.uniform(-0.03, 0.03)
        solids.append(box((at, at + 0.006), (y[0], y[1]), (0.008, 0.8 * h)))
    return solids


# --- scenes


@dataclass(frozen=True, kw_only=True)
class Lying:
    """A part, its true pose X_BP (4,4), the scans (H,W,3) with their scanners' poses X_BC (4,4), and a guess or None.

    cause: words of the refusal that is the right answer, where a pose would be wrong.
    """

    kind: str
    seed: int
    part: list[Solid]
    X_BP: Array
    scans: list[Array]
    X_BC: list[Array]
    guess: Array | None = None
    cause: str | None = None
    looked_for: list[Solid] | None = None
    others: list[Solid] = field(default_factory=list)


TABLE = box((-1.5, 1.5), (-1.5, 1.5), (-0.03, 0.0))
FLOOR = box((-4.0, 4.0), (-4.0, 4.0), (-0.95, -0.9))


def bounds(solids: Sequence[Solid]) -> Array:
    """(2,3) least and greatest coordinates."""
    p = triangles(solids)[0]
    return np.array([p.min(axis=0), p.max(axis=0)])


def beside(rng: np.random.Generator, at: Array, count: int, reach: float = 0.3) -> list[Solid]:
    """Boxes and tubes on the table, clear of bounds at (2,3)."""
    found: list[Solid] = []
    for _ in range(100):
        if len(found) == count:
            break
        p = 0.5 * at.sum(axis=0)[:2] + rng.uniform(-reach, reach, 2)
        if rng.uniform() < 0.35:
            r, h = rng.uniform(0.012, 0.04), rng.uniform(0.02, 0.1)
            one: Solid = Tube(pose((*p, h / 2)), r, 0.7 * r, h / 2)
            size = r
        else:
            half = 0.5 * rng.uniform([0.03, 0.03, 0.002], [0.12, 0.08, 0.08])
            one = Box(pose((*p, half[2]), (0, 0, rng.uniform(-3, 3))), half)
            size = float(np.hypot(*half[:2]))
        clear = ((p - size > at[1, :2] + 0.004) | (p + size < at[0, :2] - 0.004)).any()
        if clear and all(np.linalg.norm(o.X[:2, 3] - p) > o.reach + size for o in found):
            found.append(one)
    return found


def toggle_clamps(rng: np.random.Generator, base: Solid, count: int) -> list[Solid]:
    """Clamps at the rims of a base sheet: a foot beside it, an arm over it and a pad that presses on it."""
    assert isinstance(base, Box)
    hx, hy, hz = base.half
    found: list[Solid] = []
    for _ in range(count):
        side, along = (1.0 if rng.uniform() < 0.5 else -1.0), rng.uniform(-0.7, 0.7) * hx
        arm = rng.uniform(0.012, 0.02)
        y = side * (hy + 0.02)
        pieces = [
            box((along - 0.015, along + 0.015), (min(y, y + side * 0.03), max(y, y + side * 0.03)), (-hz, 0.045)),
            box(
                (along - 0.007, along + 0.007),
                (min(y, y - side * (0.02 + arm)), max(y, y - side * (0.02 + arm))),
                (0.03, 0.04),
            ),
            Tube(pose((along, side * (hy - 0.7 * arm), hz + 0.014)), 0.006, 0.0, 0.0138),
        ]
        found += put(pieces, base.X)
    return found


def _view(
    rng: np.random.Generator,
    at: Array,
    far: tuple[float, float] = (0.75, 0.95),
    slant: float = 0.4,
    up: Array | None = None,
) -> Array:
    """A scanner roughly above a place (3,), or in front of a face with normal `up` (3,)."""
    z = np.array([0.0, 0.0, 1.0]) if up is None else up
    side = np.cross(z, rng.normal(size=3))
    side /= np.linalg.norm(side)
    lean = slant * math.sqrt(rng.uniform())
    eye = at + rng.uniform(*far) * (math.cos(lean) * z + math.sin(lean) * side)
    return looking(eye, at + rng.uniform(-0.03, 0.03, 3), rng.uniform(-0.4, 0.4))


def _on_table(rng: np.random.Generator, turn: float | None = None) -> Array:
    angle = rng.uniform(-math.pi, math.pi) if turn is None else turn
    x, y = rng.uniform(-0.05, 0.05, 2)
    return pose((0.6 + x, y, 0.0), (0, 0, angle))


def _one(
    kind: str, seed: int, part: list[Solid], X: Array, others: list[Solid], rng: np.random.Generator, **more: Any
) -> Lying:
    shiny = more.pop("shiny", ())
    up, slant = more.pop("up", None), more.pop("slant", 0.4)
    placed = put(part, X)
    X_BC = _view(rng, 0.5 * bounds(placed).sum(axis=0), slant=slant, up=up)
    cloud = scan([*placed, *others, TABLE, FLOOR], X_BC, rng, shiny)
    return Lying(kind=kind, seed=seed, part=part, X_BP=X, scans=[cloud], X_BC=[X_BC], others=others, **more)


def thin(seed: int, rng: np.random.Generator) -> Lying:
    part, X = sheet_with_web(rng), _on_table(rng)
    return _one("thin sheet", seed, part, X, beside(rng, bounds(put(part, X)), 6), rng)


def flat(seed: int, rng: np.random.Generator) -> Lying:
    part, X = flat_sheet(rng), _on_table(rng)
    return _one("flat sheet", seed, part, X, beside(rng, bounds(put(part, X)), 5), rng)


def clamped(seed: int, rng: np.random.Generator) -> Lying:
    part = [sheet_with_web, bracket, tube_on_plate][seed % 3](rng)
    X = _on_table(rng)
    return _one(
        "clamps", seed, part, X, put(toggle_clamps(rng, part[0], 4), X) + beside(rng, bounds(put(part, X)), 3), rng
    )


def hidden(seed: int, rng: np.random.Generator) -> Lying:
    """A cover hangs over one half of the part's length."""
    part = [bracket, frame, tube_on_plate][seed % 3](rng)
    X = _on_table(rng)
    low, high = bounds(part)
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    inner = rng.uniform(0.0, 0.1) * (high[0] - low[0])
    xs = sorted((side * inner, side * (inner + 0.4)))
    cover = box((xs[0], xs[1]), (-0.25, 0.25), (high[2] + 0.01, high[2] + 0.02))
    return _one("half hidden", seed, part, X, put([cover], X) + beside(rng, bounds(put(part, X)), 2), rng, slant=0.2)


def long_beam(seed: int, rng: np.random.Generator) -> Lying:
    """Three scans along the beam; each is fused with an X_BC that is off by up to 0.1 mm."""
    part = beam(rng)
    X = pose((0.6, 0.0, 0.0), (0, 0, rng.uniform(-math.pi, math.pi)))
    others = beside(rng, bounds(put(part, X)), 3, 0.6)
    scans, poses = [], []
    for x in (-0.5, 0.0, 0.5):
        at = (X @ [x, 0.0, 0.04, 1.0])[:3]
        true = looking(
            at + np.append(rng.uniform(-0.12, 0.12, 2), rng.uniform(0.78, 0.9)),
            at,
            math.atan2(X[1, 0], X[0, 0]) + rng.uniform(-0.1, 0.1),
        )
        stated = pose(rng.normal(0.0, 5e-5, 3), rng.normal(0.0, 5e-5, 3)) @ true
        cloud = scan([*put(part, X), *others, TABLE, FLOOR], true, rng)
        E = stated @ np.linalg.inv(true)
        scans.append(cloud @ E[:3, :3].T + E[:3, 3])
        poses.append(stated)
    return Lying(kind="beam in three scans", seed=seed, part=part, X_BP=X, scans=scans, X_BC=poses)


def turned(seed: int, rng: np.random.Generator) -> Lying:
    part, X = nearly_symmetric(rng), _on_table(rng)
    return _one("turned by 180", seed, part, X, beside(rng, bounds(put(part, X)), 4), rng)


def two(seed: int, rng: np.random.Generator) -> Lying:
    """Two equal parts; the guess is 30 mm and 10 deg off one."""
    part = [bracket, tube_on_plate, sheet_with_web][seed % 3](rng)
    X = pose((0.6, 0.0, 0.0), (0, 0, rng.uniform(-0.5, 0.5)))
    low, high = bounds(part)
    wide = high[1] - low[1] + 0.02
    Y = X @ pose(
        (rng.uniform(-0.03, 0.03), wide, 0.0),
        (0, 0, rng.uniform(-0.1, 0.1) + (math.pi if rng.uniform() < 0.5 else 0.0)),
    )
    guess = X @ pose(rng.uniform(-0.017, 0.017, 3), rng.uniform(-0.1, 0.1, 3))
    return _one("two equal parts", seed, part, X, put(part, Y), rng, guess=guess)


def shiny(seed: int, rng: np.random.Generator) -> Lying:
    part = [bracket, tube_on_plate, frame][seed % 3](rng)
    X = _on_table(rng)
    return _one("shiny", seed, part, X, beside(rng, bounds(put(part, X)), 4), rng, shiny=range(len(part)))


def on_positioner(seed: int, rng: np.random.Generator) -> Lying:
    """The part is clamped on a positioner's plate at any angle up to 85 deg; the scanner looks at the plate."""
    part = [bracket, sheet_with_web, tube_on_plate][seed % 3](rng)
    tilt = rng.uniform(-1.48, 1.48)
    plate = pose((0.6, 0.0, 0.5), (tilt, 0, 0)) @ pose((0, 0, 0), (0, 0, rng.uniform(-3, 3)))
    X = plate @ pose((*rng.uniform(-0.03, 0.03, 2), 0.0), (0, 0, rng.uniform(-3, 3)))
    disc = put([Tube(pose((0, 0, -0.015)), 0.28, 0.0, 0.015), Tube(pose((0, 0, -0.1)), 0.08, 0.0, 0.07)], plate)
    clamps = put(toggle_clamps(rng, part[0], 2), X)
    return _one("positioner", seed, part, X, disc + clamps, rng, up=plate[:3, 2])


def in_fixture(seed: int, rng: np.random.Generator) -> Lying:
    """Stops touch two sides, rest blocks carry the part, a bar lies across it."""
    part = [bracket, frame, sheet_with_web][seed % 3](rng)
    low, high = bounds(part)
    X = _on_table(rng) @ pose((0, 0, 0.025))
    blocks: list[Solid] = [
        box((x - 0.015, x + 0.015), (y - 0.015, y + 0.015), (-0.025, 0.0))
        for x in (0.7 * low[0], 0.7 * high[0])
        for y in (0.7 * low[1], 0.7 * high[1])
    ]
    stops: list[Solid] = [
        box((low[0] - 0.02, low[0] - 0.0002), (-0.03, 0.03), (-0.025, 0.02)),
        box((-0.05, 0.02), (low[1] - 0.02, low[1] - 0.0002), (-0.025, 0.02)),
    ]
    bar: list[Solid] = [
        box((0.3 * low[0], 0.3 * low[0] + 0.02), (low[1] - 0.04, high[1] + 0.04), (high[2] + 0.001, high[2] + 0.02))
    ]
    return _one("fixture", seed, part, X, put(blocks + stops + bar, X) + beside(rng, bounds(put(part, X)), 2), rng)


# --- scenes in which a pose would be wrong


def mirrored(seed: int, rng: np.random.Generator) -> Lying:
    """The part of the other hand lies there."""
    s = clamped(3 * seed, rng)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    boxes: list[Solid] = [Box(flip @ b.X @ flip, b.half) for b in s.part if isinstance(b, Box)]
    return replace(s, kind="mirror image", looked_for=boxes, cause="mirror image fits better")


def two_unnamed(seed: int, rng: np.random.Generator) -> Lying:
    """Two equal parts and no guess."""
    return replace(two(seed, rng), kind="two, no guess", guess=None, cause="Two places in the scan")


def fused_wrongly(seed: int, rng: np.random.Generator) -> Lying:
    """One of three scans is fused with a pose of the arm that is 12 mm and 1 deg off."""
    s = long_beam(seed, rng)
    E = s.X_BC[1] @ pose((0.012, 0.008, 0.005), (0.01, 0.0, 0.017)) @ np.linalg.inv(s.X_BC[1])
    s.scans[1] = s.scans[1] @ E[:3, :3].T + E[:3, 3]
    s.X_BC[1] = E @ s.X_BC[1]
    return replace(s, kind="fused wrongly", cause="scans")


def middle_only(seed: int, rng: np.random.Generator) -> Lying:
    """Only the beam's middle is scanned, between two stiffeners."""
    s = long_beam(seed, rng)
    bare = s.part[:2]
    cloud = scan([*put(bare, s.X_BP), TABLE, FLOOR], s.X_BC[1], rng)
    return replace(
        s, kind="beam's middle", part=bare, scans=[cloud], X_BC=[s.X_BC[1]], cause="larger than .*scan|free along"
    )


def larger(seed: int, rng: np.random.Generator) -> Lying:
    """The drawing is 8 % larger than the part."""
    s = shiny(3 * seed, rng)
    big: list[Solid] = [
        Box(np.block([[b.X[:3, :3], 1.08 * b.X[:3, 3:]], [b.X[3:]]]), 1.08 * b.half)
        for b in s.part
        if isinstance(b, Box)
    ]
    return replace(s, kind="8 % larger", looked_for=big, cause="check which part|does not fit|fits the part")


def absent(seed: int, rng: np.random.Generator) -> Lying:
    """Another part lies there."""
    s = thin(seed, rng)
    return replace(s, kind="absent", looked_for=bracket(rng), cause="check which part|does not fit|fits the part|only")


REFUSED: list[Callable[[int, np.random.Generator], Lying]] = [
    mirrored, two_unnamed, fused_wrongly, middle_only, larger, absent,
]  # fmt: skip
SCENES: list[Callable[[int, np.random.Generator], Lying]] = [
    thin, flat, clamped, hidden, long_beam, turned, two, shiny, on_positioner, in_fixture,
]  # fmt: skip
EACH = 6


def scene(kind: int, seed: int) -> Lying:
    """Scene number `seed` of a kind; kinds from len(SCENES) on are those that must be refused."""
    return [*SCENES, *REFUSED][kind](seed, np.random.default_rng([seed, kind, 4304]))


@dataclass(frozen=True)
class Verdict:
    """right, wrong or refused, the largest displacement of a corner in mm, the sentence and the time in s."""

    verdict: str
    off_mm: float
    sentence: str
    seconds: float


def judge(s: Lying) -> Verdict:
    """Register one scene with the program, and compare with the truth."""
    from pydrake.math import RigidTransform

    from weldcal.models.errors import WeldcalError
    from weldcal.models.mesh import TriMesh
    from weldcal.welding.locate.part.registration import register_part

    corners, faces = triangles(s.part)
    mesh = TriMesh(*triangles(s.looked_for)) if s.looked_for else TriMesh(corners, faces)
    hint = None if s.guess is None else RigidTransform(s.guess)
    start = time.process_time()
    eyes = [X[:3, 3] for X in s.X_BC]
    one = len(s.scans) == 1
    try:
        found = register_part(s.scans[0] if one else s.scans, mesh, eye_B=eyes[0] if one else eyes, X_BP_hint=hint)
    except WeldcalError as error:
        named = s.cause is not None and re.search(s.cause, str(error))
        return Verdict("right" if named else "refused", math.nan, str(error), time.process_time() - start)
    X = found.X_BP.GetAsMatrix4()
    p = np.column_stack([corners, np.ones(len(corners))])
    off = float(np.linalg.norm((p @ (X - s.X_BP).T)[:, :3], axis=1).max())
    right = off < RIGHT_M and s.cause is None
    return Verdict("right" if right else "wrong", 1e3 * off, found.summary, time.process_time() - start)


def main() -> None:
    """Print a line a scene and the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=JUDGED_SEED, help="first seed; the judged one is the default")
    parser.add_argument("--each", type=int, default=EACH, help="scenes of each kind")
    parser.add_argument("--kinds", type=int, nargs="*", default=range(len(SCENES)))
    given = parser.parse_args()
    found = []
    for kind in given.kinds:
        for seed in range(given.seed, given.seed + given.each):
            s = scene(kind, seed)
            v = judge(s)
            found.append(v.verdict)
            print(
                f"{s.kind:20s} {seed:5d} {v.verdict:8s} {v.off_mm:7.2f} mm {v.seconds:5.1f} s  {v.sentence}", flush=True
            )
    print(
        f"{len(found)} scenes: right {found.count('right')}, wrong {found.count('wrong')}, "
        f"refused {found.count('refused')}"
    )
    sys.exit(int(found.count("wrong") > 0))


if __name__ == "__main__":
    main()
