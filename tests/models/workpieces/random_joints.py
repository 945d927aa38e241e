"""Random joints of separate solids with the seams that they have, and the share that is found; mm.

python tests/models/workpieces/random_joints.py [COUNT] [FIRST SEED] [stl] prints the figure; with stl of the same
solids as triangles.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from OCP.TopAbs import TopAbs_ShapeEnum

from tests.worlds.parts.step_parts import assembly, box, cylinder, fused, less, prism
from weldcal.models.workpieces.brep import parts_of
from weldcal.models.workpieces.joints import closes, joints_of
from weldcal.models.workpieces.reading import read_shape

Floats = npt.NDArray[np.float64]
TOLERANCE_MM = 0.05  # of a seam's ends, its length and of a ring's points


@dataclass(frozen=True)
class Seam:
    """A seam: its type, its two ends (2,3), or of a ring some points on it (N,3), and its length."""

    type: str
    points: Floats
    length: float
    ring: bool = False


Case = tuple[list[Any], list[Seam]]
KINDS: dict[str, Callable[[np.random.Generator], Case]] = {}


def kind(make: Callable[[np.random.Generator], Case]) -> Callable[[np.random.Generator], Case]:
    KINDS[make.__name__] = make
    return make


def line(type: str, a: Any, b: Any) -> Seam:
    p = np.array([a, b], dtype=float)
    return Seam(type, p, float(np.linalg.norm(p[1] - p[0])))


def ring(type: str, *corners: Any) -> Seam:
    p = np.array(corners, dtype=float)
    return Seam(type, p, float(np.linalg.norm(np.roll(p, -1, axis=0) - p, axis=1).sum()), True)


def circle(type: str, centre: Any, radius: float) -> Seam:
    a = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    p = np.asarray(centre, dtype=float) + radius * np.column_stack([np.cos(a), np.sin(a), 0.0 * a])
    return Seam(type, p, 2.0 * np.pi * radius, True)


def gap_of(rng: np.random.Generator, low: float = -2.0) -> float:
    """Touching in a third of the parts."""
    return 0.0 if rng.random() < 0.33 else float(rng.uniform(low, 3.0))


@kind
def t_flush(rng: np.random.Generator) -> Case:
    """A web as long as its plate: left and right."""
    L, W, t, h, web, g = *rng.uniform((80, 60, 4), (400, 250, 20)), *rng.uniform((40, 3), (120, 20)), gap_of(rng)
    y = rng.uniform(10.0, W - 10.0 - web)
    plates = [box((0, 0, -t), (L, W, t)), box((0, y, g), (L, web, h))]
    return plates, [line("T", (0, v, 0), (L, v, 0)) for v in (y, y + web)]


@kind
def t_around(rng: np.random.Generator) -> Case:
    """A web that is shorter than its plate: once around it."""
    L, W, t, h, web, g = *rng.uniform((80, 60, 4), (400, 250, 20)), *rng.uniform((40, 3), (120, 20)), gap_of(rng)
    x, y = rng.uniform(8.0, 0.3 * L), rng.uniform(10.0, W - 10.0 - web)
    plates = [box((0, 0, -t), (L, W, t)), box((x, y, g), (L - 2 * x, web, h))]
    return plates, [ring("T", (x, y, 0), (L - x, y, 0), (L - x, y + web, 0), (x, y + web, 0))]


@kind
def corner_on_top(rng: np.random.Generator) -> Case:
    """A plate that stands on another, flush with its end: inside, and outside a flush seam."""
    L, W, t, h, web, g = *rng.uniform((80, 60, 4), (400, 250, 20)), *rng.uniform((40, 3), (120, 20)), gap_of(rng)
    plates = [box((0, 0, -t), (L, W, t)), box((0, 0, g), (L, web, h))]
    return plates, [line("corner", (0, web, 0), (L, web, 0)), line("corner", (0, 0, g / 2), (L, 0, g / 2))]


@kind
def corner_open(rng: np.random.Generator) -> Case:
    """Two plates whose edges touch: a right angle inside and one outside."""
    L, t, w, h, u = rng.uniform((80, 4, 50, 50, 4), (400, 20, 200, 200, 20))
    g = float(rng.choice([0.0, rng.uniform(0.0, 2.0)]))
    plates = [box((0, -w, -t), (L, w, t)), box((0, 0, g), (L, u, h))]
    return plates, [line("corner", (0, 0, 0), (L, 0, 0)), line("corner", (0, 0, g), (L, 0, g))]


@kind
def lap(rng: np.random.Generator) -> Case:
    """Two sheets over each other: above and below."""
    L, t, u, w, v, g = *rng.uniform((80, 0.8, 0.8), (300, 10, 10)), *rng.uniform((60, 60), (200, 200)), 0.0
    over = rng.uniform(15.0, 40.0)
    g = 0.0 if rng.random() < 0.33 else float(rng.uniform(-min(2.0, 0.6 * min(t, u)), 3.0))
    plates = [box((0, 0, -t), (L, w, t)), box((0, w - over, g), (L, v, u))]
    return plates, [line("lap", (0, w - over, 0), (L, w - over, 0)), line("lap", (0, w, g), (L, w, g))]


@kind
def butt(rng: np.random.Generator) -> Case:
    """Two plates end to end: above and below."""
    L, t, w, v, g = *rng.uniform((80, 1.5, 50, 50), (400, 20, 200, 200)), gap_of(rng)
    plates = [box((0, -w, 0), (L, w, t)), box((0, g, 0), (L, v, t))]
    return plates, [line("butt", (0, g / 2, z), (L, g / 2, z)) for z in (0.0, t)]


@kind
def edge(rng: np.random.Generator) -> Case:
    """Two sheets face to face with one edge flush: the edge joint, and where the larger sheet goes on three laps."""
    L, t, u, w = rng.uniform((80, 1.0, 1.0, 30), (300, 6, 6, 60))
    g = gap_of(rng, 0.0)
    plates = [box((0, 0, -t), (L, w, t)), box((0, 0, g), (L, w, u))]
    return plates, [line("edge", (0, y, g / 2), (L, y, g / 2)) for y in (0.0, w)]


@kind
def v_groove(rng: np.random.Generator) -> Case:
    """Two bevelled plates with a land: the V above and the butt of the lands below."""
    L, t, w, land, g = *rng.uniform((80, 8, 50, 1.5), (400, 25, 200, 3)), gap_of(rng, 0.0)
    bevel = np.deg2rad(rng.uniform(22.5, 35.0))
    s = (t - land) * np.tan(bevel)
    left = prism([(0, 0, 0), (0, 0, land), (0, -s, t), (0, -w, t), (0, -w, 0)], (L, 0, 0))
    right = prism([(0, g, 0), (0, g, land), (0, g + s, t), (0, g + w, t), (0, g + w, 0)], (L, 0, 0))
    z = land - 0.5 * g / np.tan(bevel)
    return [left, right], [line("V", (0, g / 2, z), (L, g / 2, z)), line("butt", (0, g / 2, 0), (L, g / 2, 0))]


@kind
def hv_groove(rng: np.random.Generator) -> Case:
    """A bevelled plate beside a square one."""
    L, t, w, land, g = *rng.uniform((80, 8, 50, 1.5), (400, 25, 200, 3)), gap_of(rng, 0.0)
    bevel = np.deg2rad(rng.uniform(40.0, 55.0))
    s = (t - land) * np.tan(bevel)
    left = prism([(0, 0, 0), (0, 0, land), (0, -s, t), (0, -w - s, t), (0, -w - s, 0)], (L, 0, 0))
    right = box((0, g, 0), (L, w, t))
    z = land - g / np.tan(bevel)
    return [left, right], [line("HV", (0, g, z), (L, g, z)), line("butt", (0, g / 2, 0), (L, g / 2, 0))]


@kind
def tube_on_plate(rng: np.random.Generator) -> Case:
    """A square tube on a plate: once around it outside and inside."""
    a, b, s, h, t, g = *rng.uniform((30, 30, 2, 60, 4), (100, 100, 6, 150, 20)), gap_of(rng)
    tube = less(box((0, 0, g), (a, b, h)), box((s, s, g - 1), (a - 2 * s, b - 2 * s, h + 2)))
    plate = box((-30, -25, -t), (a + 70, b + 60, t))
    outer = ring("T", (0, 0, 0), (a, 0, 0), (a, b, 0), (0, b, 0))
    inner = ring("T", (s, s, 0), (a - s, s, 0), (a - s, b - s, 0), (s, b - s, 0))
    return [plate, tube], [outer, inner]


@kind
def pipe_on_plate(rng: np.random.Generator) -> Case:
    """A pipe on a plate: outside and inside."""
    r, s, h, t, g = *rng.uniform((15, 2, 80, 4), (70, 6, 150, 20)), gap_of(rng)
    pipe = less(cylinder((0, 0, g), r, h), cylinder((0, 0, g - 1), r - s, h + 2))
    plate = box((-r - 20, -r - 30, -t), (2 * r + 45, 2 * r + 55, t))
    return [plate, pipe], [circle("pipe on plate", (0, 0, 0), v) for v in (r, r - s)]


@kind
def flange_on_pipe(rng: np.random.Generator) -> Case:
    """A ring that a pipe goes through, with a clearance: both sides of the ring."""
    r, s, f, w, h = rng.uniform((20, 3, 6, 20, 80), (70, 6, 20, 50, 150))
    c = float(rng.choice([0.0, rng.uniform(0.05, 1.0)]))
    pipe = less(cylinder((0, 0, 0), r, h), cylinder((0, 0, -1), r - s, h + 2))
    flange = less(cylinder((0, 0, 30), r + w, f), cylinder((0, 0, 0), r + c, h))
    return [pipe, flange], [circle("flange on pipe", (0, 0, z), r) for z in (30.0, 30.0 + f)]


@kind
def pipe_butt(rng: np.random.Generator) -> Case:
    """Two pipes end to end: outside and inside."""
    r, s, h, g = *rng.uniform((15, 2, 60), (70, 6, 150)), gap_of(rng)
    pipes = [less(cylinder((0, 0, z), r, h), cylinder((0, 0, z - 1), r - s, h + 2)) for z in (0.0, h + g)]
    return pipes, [circle("butt", (0, 0, h + g / 2), v) for v in (r, r - s)]


@kind
def pipe_on_pipe(rng: np.random.Generator) -> Case:
    """A solid branch whose end is cut to a thicker pipe: the saddle."""
    R = rng.uniform(30.0, 70.0)
    r, h = rng.uniform((0.3 * R, 60), (0.8 * R, 120))
    run = cylinder((-150, 0, 0), R, 300, (1, 0, 0))
    branch = less(cylinder((0, 0, 0), r, R + h), run)
    a = np.linspace(0.0, 2.0 * np.pi, 4001)
    p = np.column_stack([r * np.cos(a), r * np.sin(a), np.sqrt(R**2 - (r * np.sin(a)) ** 2)])
    length = float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())
    return [run, branch], [Seam("pipe on pipe", p[:-1:100], length, True)]


@kind
def tab_and_slot(rng: np.random.Generator) -> Case:
    """A web with a tab in the slot of a plate, as thick as the web: the two sides above."""
    L, W, t, h, web = rng.uniform((120, 80, 4, 40, 4), (400, 250, 12, 120, 15))
    c, tab = float(rng.choice([0.0, rng.uniform(0.05, 0.5)])), rng.uniform(20.0, 50.0)
    y, x = 0.5 * (W - web), 0.5 * (L - tab)
    slot = box((x - c, y - c, -t - 1), (tab + 2 * c, web + 2 * c, t + 2))
    plate = less(box((0, 0, -t), (L, W, t)), slot)
    web_solid = fused(box((0, y, 0), (L, web, h)), box((x, y, -0.7 * t), (tab, web, 0.7 * t + 5)))
    z = -0.7 * t  # the recess below, once around
    corners = [(x - c, y - c, z), (x + tab + c, y - c, z), (x + tab + c, y + web + c, z), (x - c, y + web + c, z)]
    return [plate, web_solid], [line("T", (0, v, 0), (L, v, 0)) for v in (y, y + web)] + [ring("corner", *corners)]


def turned(shape: Any, rng: np.random.Generator) -> tuple[Any, Floats, Floats]:
    """A shape in a random orientation and place, with the rotation (3,3) and the shift (3,)."""
    from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
    from OCP.gp import gp_Quaternion, gp_Trsf, gp_Vec

    q, shift = rng.normal(size=4), rng.uniform(-300.0, 300.0, 3)
    q /= np.linalg.norm(q)
    trsf = gp_Trsf()
    trsf.SetTransformation(gp_Quaternion(*q), gp_Vec(*shift))
    R = np.array([[trsf.Value(i, j) for j in (1, 2, 3)] for i in (1, 2, 3)])
    return BRepBuilderAPI_Transform(shape, trsf, True).Shape(), R, shift


def write_stl(solids: list[Any], path: Path) -> None:
    """Write solids one after another as a binary STL file, as CAD programs export them."""
    from weldcal.models.workpieces.step import _mesh

    meshes = [_mesh(solid, path) for solid in solids]
    corners = np.concatenate([1e3 * mesh.vertices[mesh.triangles] for mesh in meshes]).astype("<f4")
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("word", "<u2")])
    rows["corners"] = corners
    path.write_bytes(b" " * 80 + len(rows).to_bytes(4, "little") + rows.tobytes())


def found_in(shape: Any) -> list[tuple[str, Floats, float, bool]]:
    """Type, points mm, length mm and whether it is closed, of each seam of a shape."""
    found = []
    for pieces in joints_of(shape):
        longest = max(pieces, key=lambda p: float(np.linalg.norm(np.diff(p.line, axis=0), axis=1).sum()))
        length = sum(float(np.linalg.norm(np.diff(p.line, axis=0), axis=1).sum()) for p in pieces)
        found.append((longest.type, np.concatenate([piece.line for piece in pieces]), length, closes(pieces)))
    return found


def found_in_mesh(shape: Any) -> list[tuple[str, Floats, float, bool]]:
    """The same of its triangles."""
    with TemporaryDirectory() as folder:
        write_stl(parts_of(shape, TopAbs_ShapeEnum.TopAbs_SOLID), Path(folder) / "part.stl")
        read = read_shape(Path(folder) / "part.stl")
    found = []
    for joint in read.joints:
        lines = [1e3 * read.edge(id).points_P for id in joint.edges]
        for k in range(1, len(lines)):  # an edge of the mesh keeps its own direction
            ends = np.linalg.norm(lines[k][[0, -1], None] - lines[k - 1][[0, -1]], axis=2)
            if k == 1 and ends[:, 0].min() < ends[:, 1].min():
                lines[0] = lines[0][::-1]
                ends = ends[:, ::-1]
            if ends[1, 1] < ends[0, 1]:
                lines[k] = lines[k][::-1]
        found.append((joint.type, np.concatenate(lines), 1e3 * joint.length_m, joint.closed))
    return found


def mistakes(name: str, seed: int, of: Callable[[Any], list[tuple[str, Floats, float, bool]]] = found_in) -> list[str]:
    """What is wrong with the seams that are found at one random joint."""
    rng = np.random.default_rng([seed, list(KINDS).index(name)])
    solids, seams = KINDS[name](rng)
    shape, R, shift = turned(assembly(*solids), rng)
    found = [(type, (points - shift) @ R, length, closed) for type, points, length, closed in of(shape)]
    wrong = []
    for seam in seams:
        k = next((k for k, f in enumerate(found) if _same(seam, f)), None)
        if k is None:
            wrong.append(f"missing {seam.type} {np.round(seam.points[:2], 2).tolist()} {seam.length:.1f}")
        else:
            found.pop(k)
    return wrong + [f"no joint: {f[0]} {np.round(f[1][[0, -1]], 2).tolist()} {f[2]:.1f}" for f in found]


def _same(seam: Seam, found: tuple[str, Floats, float, bool]) -> bool:
    name, points, length, closed = found
    if name != seam.type or closed != seam.ring or abs(length - seam.length) > TOLERANCE_MM + 1e-4 * seam.length:
        return False
    if not seam.ring:
        ends = points[[0, -1]]
        return bool(min(np.abs(ends - seam.points).max(), np.abs(ends[::-1] - seam.points).max()) < TOLERANCE_MM)
    a, d = points[:-1], np.diff(points, axis=0)
    v = seam.points[:, None] - a
    s = np.clip(np.sum(v * d, axis=2) / np.maximum(np.sum(d * d, axis=1), 1e-12), 0.0, 1.0)
    return bool(np.linalg.norm(v - s[..., None] * d, axis=2).min(axis=1).max() < TOLERANCE_MM)


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "stl"]
    count, first = (int(word) for word in words + ["2000", "0"][len(words) :])
    of = found_in_mesh if "stl" in sys.argv else found_in
    bad = 0
    for n in range(count):
        name, seed = list(KINDS)[n % len(KINDS)], first + n // len(KINDS)
        wrong = mistakes(name, seed, of)
        if wrong:
            bad += 1
            print(name, seed, *wrong, sep="\n    ", flush=True)
        if n % 100 == 99:
            print(f"{n + 1 - bad} of {n + 1} random joints right", flush=True)
    sys.exit(bad > 0)
