"""Simulated scans of workpieces: a part on a table with other objects, ray-cast for any scanner preset."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import cKDTree

from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import ScannerPreset, cast, get_scanner
from weldcal.models.workpieces.part import bend
from weldcal.models.workpieces.plate import Workpiece, make_workpiece
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
    """A box that rests on z = 0, m."""
    corners = 0.5 * np.array([(-length, -width), (length, -width), (length, width), (-length, width)])
    return extrude(corners, 0.0, height)


def table() -> TriMesh:
    """A table whose top is z = 0."""
    return box(TABLE_M, TABLE_M, 0.02).transformed(RigidTransform([0.6, 0.0, -0.02]))


def looking_at(eye: Floats, target: Floats) -> RigidTransform:
    """X_BC of a camera at `eye` (3,) that looks at `target` (3,), image rows along x of the base as near as can be."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), eye)


def random_pose(rng: np.random.Generator, part: Workpiece, tilt_rad: float, spread_m: float = 0.06) -> RigidTransform:
    """X_BP of a part wedged up on the table: any turn, a tilt up to `tilt_rad` in any direction, its underside free."""
    heading, tilt = rng.uniform(-math.pi, math.pi), tilt_rad * math.sqrt(rng.uniform())
    axis = tilt * np.array([math.cos(heading), math.sin(heading)])
    R = RotationMatrix(RollPitchYaw(axis[0], axis[1], 0.0)) @ RotationMatrix.MakeZRotation(
        rng.uniform(-math.pi, math.pi)
    )
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
    """A part in a random place and turn under a scanner that hangs roughly above it.

    Everything random, the scanner's place and noise included, follows from the seed.
    """
    rng = np.random.default_rng([seed, 41])
    X = random_pose(rng, part, tilt_rad, spread_m)
    far = min(0.93, 0.97 * scanner.far_m)
    around, slant = rng.uniform(-math.pi, math.pi), SLANT_RAD * math.sqrt(rng.uniform())
    target = np.array([0.6, 0.0, 0.02])
    eye = target + far * np.array(
        [math.sin(slant) * math.cos(around), math.sin(slant) * math.sin(around), math.cos(slant)]
    )
    X_BC = looking_at(eye, target)
    X_BC = RigidTransform(X_BC.rotation() @ RotationMatrix.MakeZRotation(rng.uniform(-0.3, 0.3)), eye)
    cloud = cast([part.mesh.transformed(X), table(), *others], X_BC, scanner, seed)
    return Scene(cloud, eye, X, part)


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
    """A workpiece that the preset's field of view holds in any turn."""
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
    """A part under that preset, at most `widest_px` wide (None: as the scanner has it), in a random pose tilted by up
    to 5 deg."""
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
    """A kind of scene. others: objects beside the part; drawing: what is looked for, None: the part itself; must: what
    the answer has to be, empty where a plan with an honest sigma and a refusal are both right.
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
