"""Simulated scans of workpieces and of STEP parts among clutter on a table, ray-cast for any scanner preset."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import cKDTree

from tests.worlds.parts.step_parts import PARTS
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh, extrude, merge, revolve
from weldcal.models.scanners import ScannerPreset, cast, get_scanner
from weldcal.models.workpieces.part import bend
from weldcal.models.workpieces.plate import Workpiece, make_workpiece
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.welding.locate.part.result import AmbiguousPart, PartNotFound
from weldcal.welding.locate.planes import Floats, into

TABLE_M = 1.4
SLANT_RAD = 0.1  # of the scanner against the vertical, at most


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan p_BS (H,W,3) m, NaN where nothing was measured, and the true pose."""

    cloud_B: Floats
    eye_B: Floats
    X_BP: RigidTransform
    part: Workpiece


def box(length: float, width: float, height: float) -> TriMesh:
    """Return a box that rests on z = 0, m."""
    corners = 0.5 * np.array([(-length, -width), (length, -width), (length, width), (-length, width)])
    return extrude(corners, 0.0, height)


def table() -> TriMesh:
    """Return a table whose top is z = 0."""
    return box(TABLE_M, TABLE_M, 0.02).transformed(RigidTransform([0.6, 0.0, -0.02]))


def looking_at(eye: Floats, target: Floats) -> RigidTransform:
    """X_BC of a camera at `eye` (3,) that looks at `target` (3,), image rows along x of the base as near as can be."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), eye)


def wedged(rng: np.random.Generator, tilt_rad: float) -> RotationMatrix:
    """R_BP of a part at any turn, wedged up by a tilt of at most `tilt_rad` in any direction."""
    heading, tilt = rng.uniform(-math.pi, math.pi), tilt_rad * math.sqrt(rng.uniform())
    axis = tilt * np.array([math.cos(heading), math.sin(heading)])
    turn = RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi))
    return RotationMatrix(RollPitchYaw(axis[0], axis[1], 0.0)) @ turn


def hung(
    rng: np.random.Generator, target: Floats, slant_rad: float, far_m: Callable[[], float], turn_rad: float
) -> RigidTransform:
    """X_BC of a scanner roughly above `target` (3,), up to `slant_rad` off the vertical and turned by `turn_rad`."""
    around, slant = rng.uniform(-math.pi, math.pi), slant_rad * math.sqrt(rng.uniform())
    aside = math.sin(slant)
    X = looking_at(
        target + far_m() * np.array([aside * math.cos(around), aside * math.sin(around), math.cos(slant)]), target
    )
    turn = RotationMatrix.MakeZRotation(rng.uniform(-turn_rad, turn_rad))
    return RigidTransform(X.rotation() @ turn, X.translation())


def random_pose(rng: np.random.Generator, part: Workpiece, tilt_rad: float, spread_m: float = 0.06) -> RigidTransform:
    """X_BP of a part wedged up on the table: any turn, a tilt up to `tilt_rad` in any direction, its underside free."""
    R = wedged(rng, tilt_rad)
    lift = -float((part.mesh.vertices @ R.matrix().T)[:, 2].min()) + 0.0005
    x, y = np.array([0.6, 0.0]) + rng.uniform(-spread_m, spread_m, size=2)
    return RigidTransform(R, [x, y, lift])


def scan_part(
    part: Workpiece,
    scanner: ScannerPreset,
    seed: int,
    *,
    tilt_rad: float = 0.0,
    spread_m: float = 0.06,
    others: Sequence[TriMesh] = (),
) -> Scene:
    """Return a part in a random place and turn under a scanner that hangs roughly above it.

    Everything random, the scanner's place and noise included, follows from the seed.
    """
    rng = np.random.default_rng([seed, 41])
    X = random_pose(rng, part, tilt_rad, spread_m)
    far = min(0.93, 0.97 * scanner.far_m)
    X_BC = hung(rng, np.array([0.6, 0.0, 0.02]), SLANT_RAD, lambda: far, 0.3)
    cloud = cast([part.mesh.transformed(X), table(), *others], X_BC, scanner, seed)
    return Scene(cloud, np.asarray(X_BC.translation()), X, part)


def sideways(points_B: Floats, part: Workpiece, X_BP: RigidTransform) -> tuple[Floats, Floats]:
    """Signed distances (N,) of points from the true root line, in the plate's face to the left, and in height, m."""
    p = into(X_BP, points_B)
    nearest = np.asarray(cKDTree(part.seam_P).query(p)[1])
    up = np.broadcast_to(part.up_P, part.seam_P.shape)[nearest]
    left = np.cross(up, part.tangents_P[nearest])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    gap = p - part.seam_P[nearest]
    return np.sum(gap * left, axis=1), np.sum(gap * up, axis=1)


WIDEST_PX = 824
CORNER_M, BEND_M = 0.004, 0.200


def part_for(preset: str, shape: str) -> Workpiece:
    """Return a workpiece that the preset's field of view holds in any turn."""
    scanner = get_scanner(preset)
    small = min(scanner.footprint_m(min(0.93, 0.97 * scanner.far_m))) < 0.35
    kind = {"corner": "l", "bent": "s"}.get(shape, shape)
    radius = CORNER_M if shape == "corner" else None
    if small:
        part = make_workpiece(kind, length_m=0.200, width_m=0.130 if kind != "l" else 0.150, radius_m=radius)
    else:
        part = make_workpiece(kind, length_m=0.200 if shape == "bent" else 0.300, radius_m=radius)
    return bend(part, BEND_M) if shape == "bent" else part


def scan(preset: str, shape: str, seed: int, widest_px: int | None = WIDEST_PX) -> Scene:
    """Scan a part with that preset, in a random pose tilted by up to 5 deg.

    The image is at most `widest_px` wide (None: as the scanner has it).
    """
    scanner = get_scanner(preset)
    scanner = scanner.resized(widest_px) if widest_px is not None and scanner.width > widest_px else scanner
    part = part_for(preset, shape)
    return scan_part(part, scanner, seed, tilt_rad=math.radians(5.0), spread_m=0.0 if part.size_m[1] < 0.16 else 0.05)


def barred(width_m: float) -> Callable[[np.random.Generator], list[TriMesh]]:
    """A bar 60 mm over the part, across its middle."""

    def made(rng: np.random.Generator) -> list[TriMesh]:
        turn = RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi))
        p = [0.6 + rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), 0.11]
        return [box(0.6, width_m, 0.01).transformed(RigidTransform(turn, p))]

    return made


def cluttered(rng: np.random.Generator) -> list[TriMesh]:
    """Boxes around the part, some as high as it, and one on its edge."""
    meshes = []
    for _ in range(8):
        angle, far = rng.uniform(-math.pi, math.pi), rng.uniform(0.16, 0.32)
        X = RigidTransform(
            RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi)),
            [0.6 + far * math.cos(angle), far * math.sin(angle), 0.0],
        )
        size = rng.uniform([0.03, 0.03, 0.01], [0.12, 0.08, 0.08])
        meshes.append(box(*(float(v) for v in size)).transformed(X))
    return meshes


PLANNED, REFUSED = "planned", "refused"


@dataclass(frozen=True)
class Trouble:
    """A kind of scene. others: objects beside the part; drawing: what is looked for, None: the part itself.

    `must`: what the answer has to be, empty where a plan with an honest sigma and a refusal are both right.
    """

    name: str
    part: Callable[[], Workpiece]
    must: str
    method: str
    others: Callable[[np.random.Generator], list[TriMesh]] = lambda rng: []
    drawing: Callable[[], Workpiece] | None = None


def _s() -> Workpiece:
    return make_workpiece("s", length_m=0.250)


def _flat() -> Workpiece:
    return make_workpiece("s", length_m=0.200)


def _bent(radius_m: float) -> Callable[[], Workpiece]:
    return lambda: bend(_flat(), radius_m)


TROUBLES = (
    *(
        Trouble(name, part, must, method, others)
        for name, part, must, others in (
            ("bar of 12 mm across", _s, PLANNED, barred(0.012)),
            ("bar of 30 mm across", _s, "", barred(0.030)),
            ("clutter around", _s, PLANNED, cluttered),
            ("bent, bar of 12 mm across", _bent(BEND_M), PLANNED, barred(0.012)),
        )
        for method in ("cad", "cloud")
    ),
    *(
        Trouble(f"wrong: {name}", part, REFUSED, "cad", drawing=drawing)
        for name, part, drawing in (
            ("6 mm wider", lambda: make_workpiece("s", length_m=0.250, width_m=0.206), _s),
            ("5 mm longer", lambda: make_workpiece("s", length_m=0.255), _s),
            ("another groove", lambda: make_workpiece("straight", length_m=_s().size_m[0]), _s),
            ("bent, drawn flat", _bent(BEND_M), _flat),
            ("flat, drawn bent", _flat, _bent(BEND_M)),
            ("bent over 230 mm, drawn 200", _bent(0.230), _bent(BEND_M)),
        )
    ),
)


MIDDLE = np.array([0.6, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Subject:
    """A part with its drawn seam in frame P, m."""

    name: str
    mesh: TriMesh
    seam: DrawnSeam


@dataclass(frozen=True, eq=False)
class PartScene:
    """A scan p_BS (H,W,3) m, NaN where nothing was measured, the scanner's position and the true pose."""

    cloud_B: Floats
    eye_B: Floats
    X_BP: RigidTransform


@cache
def subject(name: str) -> Subject:
    """One of the made parts, read back from its STEP file and its seam's CSV."""
    with tempfile.TemporaryDirectory() as folder:
        made = PARTS[name]()
        step, csv = made.write(Path(folder))
        shape = read_shape(step, "mm")
        return Subject(name, shape.mesh, seam_of(shape, SeamSource(csv, (), "forward", 0.0, 0.0), made.joint))


def standing(
    mesh: TriMesh, rng: np.random.Generator, tilt_rad: float, lift_m: float, spread_m: float
) -> RigidTransform:
    """X_BP of a part as it is drawn (its z up), at any turn, wedged up by a tilt in any direction."""
    R = wedged(rng, tilt_rad)
    turned = mesh.vertices @ R.matrix().T
    middle = 0.5 * (turned.min(axis=0) + turned.max(axis=0))
    at = MIDDLE[:2] + rng.uniform(-spread_m, spread_m, size=2) - middle[:2]
    return RigidTransform(R, [at[0], at[1], lift_m - float(turned[:, 2].min()) + 0.0003])


def lying(mesh: TriMesh, rng: np.random.Generator, spread_m: float) -> RigidTransform:
    """X_BP of a part on one of its sides or upside down."""
    over = RotationMatrix.MakeXRotation(0.5 * math.pi * int(rng.integers(1, 4)))
    if rng.uniform() < 0.5:
        over = RotationMatrix.MakeYRotation(0.5 * math.pi * int(rng.integers(1, 4)))
    X = RigidTransform(over, np.zeros(3))
    return standing(mesh.transformed(X), rng, 0.0, 0.0, spread_m) @ X


def vice(mesh_B: TriMesh) -> list[TriMesh]:
    """Two jaws along the part's longer sides that hide its lower third, and the vice's bed beyond its ends."""
    low, high = mesh_B.bounds
    middle, size = 0.5 * (low + high), high - low
    long = int(size[1] > size[0])
    height = max(0.004, low[2] + 0.3 * size[2])
    found = []
    for side in (-1.0, 1.0):
        jaw = box(1.1 * size[long], 0.03, height) if long == 0 else box(0.03, 1.1 * size[long], height)
        at = [middle[0], middle[1], 0.0]
        at[1 - long] += side * (0.5 * size[1 - long] + 0.0155)
        found.append(jaw.transformed(RigidTransform(at)))
    return found


def without_spots(cloud_B: Floats, mesh_B: TriMesh, rng: np.random.Generator, count: int) -> Floats:
    """The scan without round spots on the part, as a shiny face leaves them: each has a radius of 10 to 30 mm."""
    left = cloud_B.copy()
    low, high = mesh_B.bounds
    on = cloud_B[((cloud_B > low - 0.002) & (cloud_B < high + 0.002)).all(axis=-1)]
    for _ in range(count if len(on) else 0):
        middle = on[rng.integers(len(on))]
        left[np.linalg.norm(cloud_B - middle, axis=-1) < rng.uniform(0.01, 0.03)] = np.nan
    return left


def clutter(mesh_B: TriMesh, rng: np.random.Generator, count: int) -> list[TriMesh]:
    """Boxes, pipes and a fixture's clamps beside the part, none through it.

    Each drawn anew until it is clear of its bounds.
    """
    low, high = mesh_B.bounds
    found: list[TriMesh] = []
    for _ in range(200):
        if len(found) == count:
            break
        size = rng.uniform([0.02, 0.02, 0.005], [0.12, 0.08, 0.09])
        one = box(*size)
        if rng.uniform() < 0.35:
            r, h = rng.uniform(0.012, 0.045), rng.uniform(0.02, 0.12)
            one = revolve(np.array([[0.0, 0.0], [r, 0.0], [r, h], [0.0, h]]), 48)
        X = RigidTransform(
            RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi)),
            [*(MIDDLE[:2] + rng.uniform(-0.28, 0.28, size=2)), 0.0],
        )
        one = one.transformed(X)
        a, b = one.bounds
        clear = [(a[k] > high[k] + 0.004) or (b[k] < low[k] - 0.004) for k in range(2)]
        if any(clear) and not any(_meet(one, other) for other in found):
            found.append(one)
    return found


def _meet(a: TriMesh, b: TriMesh) -> bool:
    (la, ha), (lb, hb) = a.bounds, b.bounds
    return bool(((la < hb) & (lb < ha))[:2].all())


def clamps(mesh_B: TriMesh, rng: np.random.Generator, count: int) -> list[TriMesh]:
    """Fingers of a fixture that reach over the part from outside and rest on it."""
    low, high = mesh_B.bounds
    found = []
    for _ in range(count):
        angle = rng.uniform(-math.pi, math.pi)
        d = np.array([math.cos(angle), math.sin(angle)])
        half = 0.5 * (high - low)[:2]
        rim = 0.5 * (low + high)[:2] + d * min(half[0] / max(abs(d[0]), 1e-6), half[1] / max(abs(d[1]), 1e-6))
        X = RigidTransform(RotationMatrix.MakeZRotation(angle), [*(rim + 0.02 * d), float(high[2]) + 0.001])
        found.append(box(0.08, 0.02, 0.015).transformed(X))
    return found


def scan_scene(
    mesh: TriMesh,
    scanner: ScannerPreset,
    seed: int,
    *,
    objects: int = 5,
    fingers: int = 1,
    tilt_rad: float = math.radians(4.0),
    slant_rad: float = 0.35,
    spread_m: float = 0.05,
    spots: int = 0,
    on_side: bool = False,
    in_vice: bool = False,
    twice: bool = False,
) -> PartScene:
    """Return a part among clutter under a scanner that hangs roughly above it; everything random follows from the seed.

    spots: round holes in the scan of the part; twice: an equal part lies beside it.
    """
    rng = np.random.default_rng([seed, 1801])
    on_blocks = rng.uniform() < 0.3
    X = standing(mesh, rng, tilt_rad, rng.uniform(0.01, 0.04) if on_blocks else 0.0, spread_m)
    if on_side:
        X = lying(mesh, rng, spread_m)
    elif in_vice:
        X = standing(mesh, np.random.default_rng([seed, 1802]), 0.0, 0.0, spread_m)
        X = RigidTransform(RotationMatrix.MakeZRotation(0.5 * math.pi * int(rng.integers(4))), X.translation())
        middle = 0.5 * np.sum(mesh.transformed(X).bounds, axis=0) - MIDDLE
        X = RigidTransform(X.rotation(), X.translation() - [middle[0], middle[1], 0.0])
    mesh_B = mesh.transformed(X)
    X_BC = hung(rng, MIDDLE + np.array([0.0, 0.0, 0.02]), slant_rad, lambda: rng.uniform(0.78, 0.95), 0.5)
    others = clutter(mesh_B, rng, objects) + clamps(mesh_B, rng, fingers) + (vice(mesh_B) if in_vice else [])
    if twice:
        wide = mesh_B.bounds[1, 0] - mesh_B.bounds[0, 0] + 0.02
        others.append(mesh_B.transformed(RigidTransform([-wide if MIDDLE[0] < X.translation()[0] else wide, 0.0, 0.0])))
    cloud = cast([mesh_B, table(), *others], X_BC, scanner, seed)
    return PartScene(without_spots(cloud, mesh_B, rng, spots) if spots else cloud, np.asarray(X_BC.translation()), X)


def block() -> TriMesh:
    """Return a casting-like block of five boxes of unequal size: no turn maps it to itself."""
    parts = [
        box(0.14, 0.09, 0.02),
        box(0.05, 0.04, 0.07).transformed(RigidTransform([-0.035, 0.018, 0.0])),
        box(0.03, 0.05, 0.045).transformed(RigidTransform([0.045, -0.012, 0.0])),
        box(0.02, 0.02, 0.032).transformed(RigidTransform([0.005, -0.03, 0.0])),
    ]
    return merge(*parts)


MESH_NOISE_M, MESH_WAVE_M, MESH_TRIANGLES = 1e-4, 0.015, 15_000


@dataclass(frozen=True, eq=False)
class RefusedScene:
    """What lies in the scene, what is looked for, and the error with the words that must name why."""

    there: TriMesh
    looked_for: TriMesh
    error: type[WeldcalError]
    words: str
    twice: bool = False


def sphere(radius: float) -> TriMesh:
    """Return a ball that rests on z = 0, m."""
    a = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 33)
    return revolve(np.column_stack([radius * np.cos(a) * (np.abs(a) < 1.57), radius * (1.0 + np.sin(a))]), 64)


def pipe(radius: float, wall: float, height: float) -> TriMesh:
    """Return a pipe that rests on z = 0, m."""
    inner = radius - wall
    return revolve(np.array([[inner, 0.0], [radius, 0.0], [radius, height], [inner, height], [inner, 0.0]]), 72)


def _scaled(mesh: TriMesh, factor: float) -> TriMesh:
    return TriMesh(mesh.vertices * factor, mesh.triangles)


REFUSALS: dict[str, Callable[[], RefusedScene]] = {
    "plain plate": lambda: RefusedScene(
        box(0.2, 0.12, 0.012), box(0.2, 0.12, 0.012), AmbiguousPart, "turning it about its"
    ),
    "plain pipe": lambda: RefusedScene(
        pipe(0.05, 0.005, 0.09), pipe(0.05, 0.005, 0.09), AmbiguousPart, "free to turn about its z axis|looks the same"
    ),
    "sphere": lambda: RefusedScene(sphere(0.05), sphere(0.05), AmbiguousPart, "free to turn about its|looks the same"),
    "two alike": lambda: RefusedScene(block(), block(), AmbiguousPart, "Two places in the scan", twice=True),
    "another part": lambda: RefusedScene(block(), subject("lap").mesh, PartNotFound, "part"),
    "another length": lambda: RefusedScene(box(0.2, 0.12, 0.03), box(0.26, 0.12, 0.03), PartNotFound, "part"),
    "wrong unit": lambda: RefusedScene(block(), _scaled(block(), 25.4), PartNotFound, "part"),
    "not there": lambda: RefusedScene(box(0.03, 0.03, 0.02), block(), PartNotFound, "part"),
}
