"""Bent torches in a cell that is not quite right: meshes, scans ray by ray, and touches of a point and of a plate.

Nothing here uses the models of the fit. The nozzle is stepped, tapered, out of round and carries spatter; the wire is
curved. The scanner has smooth noise, flying pixels, gaps at steep surfaces, and an error that stays. The arm does not
quite reach its poses, and X_BC is off by what its covariance says.

`python -m tests.calibration.tool.torches [--tools 200] [--first 1000]` measures many and prints what the issue asks.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from pydrake.math import RigidTransform, RotationMatrix
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.calibration.tool.measure import ToolMeasurement, measure_tool
from weldcal.calibration.tool.scan_fit import ToolScan
from weldcal.calibration.tool.wire import WireTouch
from weldcal.models.tools.loading import WELDING, load_tool

WIRE_M = 1.2e-3
SCANS, TOUCHES = 12, 12
FOCAL, SIZE = 1600.0, (360, 360)
NOISE_M, FLYING = 1e-4, 0.08
REPEAT_M, REPEAT_RAD = 3e-5, np.radians(0.01)
TOUCH_M = 5e-5
CALIBRATED_RAD, CALIBRATED_M = np.radians(0.01), 5e-5
STAYS_M = 3e-5  # what is left of the scanner's own error
NOMINAL = np.array([-0.060, 0.0, 0.1715])
BALL, BALL_RADIUS = np.array([0.0, 0.0, 0.170]), 0.0025
MIDDLE = np.array([-0.030, 0.0, 0.145])


@dataclass(frozen=True)
class Wrong:
    """How a tool differs from its file: m, rad; the wire's displacement by the bend is `bend`."""

    bend: float = 0.0
    tilt: float = 0.0
    cast: float = 0.0  # of the wire, sideways
    longer: float = 0.0  # stick-out
    tip: float = 0.0


@dataclass(frozen=True)
class Truth:
    p_FW: np.ndarray
    axis: np.ndarray
    ball: np.ndarray
    stick_out: float


def lathe(profile: np.ndarray, round_by: np.ndarray, n: int = 96) -> o3d.geometry.TriangleMesh:
    """A profile (k, 2) of (radius, z) turned about z; `round_by` (n,) scales the radius around."""
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) * round_by[:, None]
    points = np.concatenate([np.column_stack([r * ring, np.full(n, z)]) for r, z in profile])
    faces = []
    for i in range(len(profile) - 1):
        a, b = i * n + np.arange(n), i * n + (np.arange(n) + 1) % n
        faces += [np.column_stack([a, b, a + n]), np.column_stack([b, b + n, a + n])]
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(np.concatenate(faces))
    )


def tube(path: np.ndarray, radius: float, n: int = 16) -> o3d.geometry.TriangleMesh:
    """A tube about a path (k, 3) that runs nearly along z."""
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    points = np.concatenate([p + ring for p in path] + [path[-1:]])
    faces = []
    for i in range(len(path) - 1):
        a, b = i * n + np.arange(n), i * n + (np.arange(n) + 1) % n
        faces += [np.column_stack([a, b, a + n]), np.column_stack([b, b + n, a + n])]
    a, b, last = (len(path) - 1) * n + np.arange(n), (len(path) - 1) * n + (np.arange(n) + 1) % n, len(points) - 1
    faces.append(np.column_stack([a, b, np.full(n, last)]))
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(np.concatenate(faces))
    )


def unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def made(wrong: Wrong, rng: np.random.Generator) -> tuple[o3d.t.geometry.RaycastingScene, Truth]:
    """The tool in F as it is, and the truth about it."""
    n = 96
    angle = 2.0 * np.pi * np.arange(n) / n
    uneven = 1.0 + 0.004 * np.cos(2.0 * angle + rng.uniform(0.0, 6.0)) + 0.002 * np.cos(3.0 * angle + rng.uniform(0, 6))
    end, stick = NOMINAL[2] - 0.012, 0.012 + wrong.longer
    outside = [(0.0, 0.024), (0.009, 0.024), (0.009, end - 0.058), (0.0112, end - 0.058), (0.0112, end - 0.030)]
    outside += [(0.0096, end - 0.012), (0.0088, end - 0.0005), (0.0083, end), (0.0065, end), (0.0065, end - 0.03)]
    parts = [lathe(np.array(outside), uneven, n)]
    parts.append(lathe(np.array([(0.004, end - 0.03), (0.004, end - 0.003), (0.0008, end - 0.003)]), np.ones(n), n))
    for _ in range(8):  # spatter
        turn, z = rng.uniform(0.0, 2.0 * np.pi), end - rng.uniform(0.0, 0.03)
        bead = o3d.geometry.TriangleMesh.create_sphere(rng.uniform(0.0005, 0.0015), 8)
        parts.append(bead.translate([0.0095 * np.cos(turn), 0.0095 * np.sin(turn), z]))
    turn = rng.uniform(0.0, 2.0 * np.pi)
    side = wrong.cast * np.array([np.cos(turn), np.sin(turn), 0.0])
    share = np.linspace(0.0, 1.0, 8)[:, None]
    path = np.array([0.0, 0.0, end - 0.003]) + share * [0.0, 0.0, stick + 0.003] + share**2 * side
    parts.append(tube(path, 0.5 * WIRE_M))
    bend = RotationMatrix(Rotation.from_rotvec(wrong.tilt * np.cross(unit(rng), [0.0, 0.0, 1.0])).as_matrix())
    if wrong.tilt:
        about = np.cross([0.0, 0.0, 1.0], unit(rng))
        bend = RotationMatrix(Rotation.from_rotvec(wrong.tilt * about / np.linalg.norm(about)).as_matrix())
    X = RigidTransform(NOMINAL + wrong.bend * unit(rng)) @ RigidTransform(bend, np.zeros(3))
    X = X @ RigidTransform([0.0, 0.0, -NOMINAL[2]])
    for part in parts:
        part.transform(X.GetAsMatrix4())
    truth = Truth(np.asarray(X @ path[-1]), bend.matrix()[:, 2], BALL + wrong.tip * unit(rng), stick)
    ball = o3d.geometry.TriangleMesh.create_sphere(BALL_RADIUS, 24).translate(truth.ball)
    rod = o3d.geometry.TriangleMesh.create_cylinder(0.0022, 0.058).translate(truth.ball - [0.0, 0.0, 0.031])
    disc = o3d.geometry.TriangleMesh.create_cylinder(0.026, 0.002).translate([0.0, 0.0, 0.109])
    camera = o3d.geometry.TriangleMesh.create_box(0.026, 0.026, 0.052).translate([-0.013, -0.013, 0.012])
    arm = o3d.geometry.TriangleMesh.create_box(0.23, 0.05, 0.012).translate([-0.08, -0.025, 0.012])
    scene = o3d.t.geometry.RaycastingScene()
    for part in (*parts, ball, rod, disc, camera, arm):
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(part))
    return scene, truth


def scanned(scene: o3d.t.geometry.RaycastingScene, X_FC: RigidTransform, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) m in C that the scanner gives, in metres."""
    w, h = SIZE
    u, v = np.meshgrid((np.arange(w) - 0.5 * w) / FOCAL, (np.arange(h) - 0.5 * h) / FOCAL)
    rays_C = np.dstack([u, v, np.ones_like(u)])
    R = X_FC.rotation().matrix()
    rays = np.concatenate([np.broadcast_to(X_FC.translation(), rays_C.shape), rays_C @ R.T], axis=2)
    hit = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    depth = hit["t_hit"].numpy().astype(float)
    normals = hit["primitive_normals"].numpy()
    facing = np.abs(np.einsum("hwi,hwi->hw", normals, rays[..., 3:])) / np.linalg.norm(rays_C, axis=2)
    seen = np.isfinite(depth) & (facing > np.cos(np.radians(78.0)))
    filled = np.where(np.isfinite(depth), depth, 10.0)
    smooth = gaussian_filter(rng.normal(size=depth.shape), 0.8)
    noisy = filled + NOISE_M * smooth / smooth.std() / np.maximum(facing, 0.2)
    nearest = np.minimum.reduce([np.roll(filled, s, axis=k) for s in (-1, 1) for k in (0, 1)])
    beside = np.abs(filled - nearest) > 0.004
    flies = seen & beside & (rng.random(depth.shape) < FLYING)
    noisy[flies] += rng.uniform(0.0, 1.0, flies.sum()) * (np.minimum(nearest, filled)[flies] - filled[flies])
    seen &= ~(beside & ~flies & (rng.random(depth.shape) < 0.3))
    return (rays_C * noisy[..., None])[seen]


@dataclass(frozen=True)
class Stay:
    """The scanner's own error that no correction has removed: a smooth field in its frame."""

    waves: np.ndarray
    phases: np.ndarray
    ways: np.ndarray

    def __call__(self, p: np.ndarray) -> np.ndarray:
        return p + STAYS_M * np.sin(p @ self.waves.T + self.phases) @ self.ways / np.sqrt(len(self.ways))


def turned(X: RigidTransform, rad: float, m: float, rng: np.random.Generator) -> RigidTransform:
    """A pose that is off by those deviations per axis, on its own side."""
    return X @ RigidTransform(
        RotationMatrix(Rotation.from_rotvec(rad * rng.normal(size=3)).as_matrix()), m * rng.normal(size=3)
    )


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What the measurement gets."""

    scans: tuple[ToolScan, ...]
    clouds: tuple[np.ndarray, ...]
    poses: tuple[RigidTransform, ...]
    X_BC: RigidTransform
    covariance: np.ndarray
    touches: tuple[WireTouch, ...]
    truth: Truth


def view(k: int, n: int, rng: np.random.Generator) -> RigidTransform:
    """X_FC of a scan that looks at the torch from one of n sides, a little from before or behind."""
    around, above = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / n, np.radians(rng.uniform(-15.0, 35.0))
    to_camera = np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])
    z = -to_camera
    x = np.cross(z, unit(rng))
    x /= np.linalg.norm(x)
    R = RotationMatrix(np.column_stack([x, np.cross(z, x), z]))
    return RigidTransform(R, MIDDLE + rng.uniform(0.60, 0.70) * to_camera + 0.01 * rng.normal(size=3))


def cell(seed: int, wrong: Wrong, scans: int = SCANS, touches: int = TOUCHES, plates: int = 0) -> Cell:
    """The cell of a seed with a tool that is wrong by so much."""
    rng = np.random.default_rng(seed)
    scene, truth = made(wrong, rng)
    X_BC = RigidTransform(
        RotationMatrix(Rotation.from_euler("xyz", [150.0, 10.0, 20.0], degrees=True).as_matrix()), [0.6, -0.2, 0.9]
    )
    sigma = np.repeat([CALIBRATED_RAD, CALIBRATED_M], 3)
    off = sigma * rng.normal(size=6)
    stated = RigidTransform(
        RotationMatrix(Rotation.from_rotvec(off[:3]).as_matrix()) @ X_BC.rotation(), X_BC.translation() + off[3:]
    )
    stay = Stay(rng.normal(size=(6, 3)) * 25.0, rng.uniform(0.0, 6.0, 6), rng.normal(size=(6, 3)))
    out, clouds, poses = [], [], []
    for k in range(scans):
        X_FC = view(k, scans, rng)
        p_C = stay(scanned(scene, X_FC, rng))
        X_BF = turned(X_BC @ X_FC.inverse(), REPEAT_RAD, REPEAT_M, rng)  # what the robot says
        p_F = np.asarray((X_BF.inverse() @ stated) @ p_C.T).T
        out.append(ToolScan(f"p{k}", p_F, X_BF.inverse(), np.asarray(stated.translation())))
        clouds.append(p_C)
        poses.append(X_BF)
    touched = [touch(f"t{k}", "point", truth, rng, k, touches) for k in range(touches)]
    touched += [touch(f"u{k}", "plate", truth, rng, k, plates) for k in range(plates)]
    return Cell(
        scans=tuple(out),
        clouds=tuple(clouds),
        poses=tuple(poses),
        X_BC=stated,
        covariance=np.diag(sigma**2),
        touches=tuple(touched),
        truth=truth,
    )


def touch(id: str, feature: str, truth: Truth, rng: np.random.Generator, k: int, n: int) -> WireTouch:
    """One touch of a spike, or of a plate with the lowest point of the wire's flat end."""
    around = 2.0 * np.pi * k / n + rng.uniform(-0.2, 0.2)
    lean = np.radians(rng.uniform(30.0, 45.0)) * (k % 5 != 0)
    R = (
        Rotation.from_rotvec(lean * np.array([np.cos(around), np.sin(around), 0.0]))
        * Rotation.from_euler("x", 180.0, degrees=True)
        * Rotation.from_euler("z", rng.uniform(-150.0, 150.0), degrees=True)
    )
    R_BF = R.as_matrix()
    place = np.array([0.5, 0.2, 0.1])
    if feature == "plate":
        normal = Rotation.from_euler("xy", [2.0, -3.0], degrees=True).as_matrix()[:, 2]
        edge = np.linspace(0.0, 2.0 * np.pi, 721)
        a = truth.axis / np.linalg.norm(truth.axis)
        u = np.cross(a, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(a, [1.0, 0.0, 0.0]))
        rim = 0.5 * WIRE_M * (np.outer(np.cos(edge), u) + np.outer(np.sin(edge), np.cross(a, u)))
        lowest = (rim @ R_BF.T @ normal).min()
        along = rng.uniform(-0.05, 0.05, 3)
        place = place + along - normal * (along @ normal) - lowest * normal
    p_BF = place - R_BF @ truth.p_FW + TOUCH_M * rng.normal(size=3)
    return WireTouch(id, turned(RigidTransform(RotationMatrix(R_BF), p_BF), REPEAT_RAD, REPEAT_M, rng), feature)


def written(c: Cell, folder: Path) -> None:
    """Write scans/ as a dataset, result/ as `weldcal calibrate` does, and touches.csv."""
    scans = folder / "scans"
    (scans / "clouds").mkdir(parents=True)
    names = "id,x,y,z,qw,qx,qy,qz"

    def row(id: str, X: RigidTransform) -> str:
        return ",".join([id, *(repr(float(v)) for v in (*X.translation(), *X.rotation().ToQuaternion().wxyz()))])

    poses = [row(s.id, X) for s, X in zip(c.scans, c.poses, strict=True)]
    (scans / "poses.csv").write_text("\n".join([names, *poses, ""]))
    units = "schema: 1\nrobot: ur10e\nflange: tool-ring-63\nconfiguration: eye_on_base\nunits: {clouds: m, poses: m}\n"
    (scans / "dataset.yaml").write_text(units)
    for scan, cloud in zip(c.scans, c.clouds, strict=True):
        np.save(scans / "clouds" / f"{scan.id}.npy", cloud.astype(np.float32))
    result = CalibrationResult(X_BC=c.X_BC, covariance=c.covariance, held_out_mm={}, tilt_deg={}, poses=())
    (folder / "result").mkdir()
    save_result(result, folder / "result")
    touches = [f"{row(t.id, t.X_BF)},{t.feature}" for t in c.touches]
    (folder / "touches.csv").write_text("\n".join([f"{names},feature", *touches, ""]))


@dataclass(frozen=True, kw_only=True)
class Judged:
    axis_deg: float
    axis_inside: bool
    axis_chi2: float
    wire_mm: float
    wire_inside: bool
    wire_chi2: float
    ball_mm: float
    ball_inside: bool
    stick_out_mm: float
    noticed: bool
    nozzle_noticed: bool


def judge(found: ToolMeasurement, truth: Truth) -> Judged:
    """How far a measurement is from the truth, and whether its 95 % regions hold it."""
    across = found.nozzle.surface.axes[:2]
    turn = across @ truth.axis
    axis2 = float(turn @ np.linalg.solve(found.axis_covariance[2:, 2:], turn))
    assert found.wire is not None
    off = found.p_FW - truth.p_FW
    wire2 = float(off @ np.linalg.solve(found.wire.covariance, off))
    ball, ball2 = np.full(3, np.nan), np.nan
    tip = found.move("tip")
    if found.ball is not None and tip is not None:
        ball = found.ball.surface.centre - truth.ball
        ball2 = float(ball @ np.linalg.solve(tip.covariance, ball))
    wire, nozzle = found.move("wire"), found.move("nozzle")
    assert wire is not None
    assert nozzle is not None
    return Judged(
        axis_deg=float(np.degrees(np.arccos(np.clip(found.axis @ truth.axis, -1.0, 1.0)))),
        axis_inside=axis2 < chi2.ppf(0.95, 2),
        axis_chi2=axis2,
        wire_mm=1e3 * float(np.linalg.norm(off)),
        wire_inside=wire2 < chi2.ppf(0.95, 3),
        wire_chi2=wire2,
        ball_mm=1e3 * float(np.linalg.norm(ball)),
        ball_inside=ball2 < chi2.ppf(0.95, 3),
        stick_out_mm=1e3 * (found.stick_out_m - truth.stick_out),
        noticed=wire.moved,
        nozzle_noticed=nozzle.moved,
    )


def random_tool(seed: int) -> Wrong:
    """A bent tool, as the issue asks, with a curved wire, another stick-out and a tip that is displaced."""
    rng = np.random.default_rng([seed, 7])
    return Wrong(
        rng.uniform(0.0, 5e-3),
        np.radians(rng.uniform(0.0, 3.0)),
        rng.uniform(0.0, 1e-3),
        rng.uniform(-1.5e-3, 1.5e-3),
        5e-4,
    )


def measured(seed: int, wrong: Wrong, scans: int = SCANS) -> Judged:
    """The measurement of a cell, judged."""
    c = cell(seed, wrong, scans)
    return judge(measure_tool(load_tool(WELDING), c.scans, c.covariance, c.touches, wire_m=WIRE_M), c.truth)


def _random(seed: int) -> Judged:
    return measured(seed, random_tool(seed))


def _half(seed: int) -> Judged:
    return measured(seed, Wrong(bend=5e-4, tilt=5e-4 / 0.15))


def _straight(seed: int) -> Judged:
    return measured(seed, Wrong())


def _said(name: str, rows: list[Judged]) -> None:
    axis, wire, ball = (np.array([getattr(r, k) for r in rows]) for k in ("axis_deg", "wire_mm", "ball_mm"))
    inside = [100.0 * np.mean([getattr(r, k) for r in rows]) for k in ("axis_inside", "wire_inside", "ball_inside")]
    print(f"{name}: {len(rows)} tools")
    for what, e, unit_ in (("axis", axis, "deg"), ("wire", wire, "mm"), ("ball", ball, "mm")):
        print(
            f"  {what}: median {np.nanmedian(e):.4f}, largest {np.nanmax(e):.4f} {unit_}, missing {np.isnan(e).sum()}"
        )
    print(f"  95 % regions hold: axis {inside[0]:.1f} %, wire {inside[1]:.1f} %, ball {inside[2]:.1f} %")
    means = [np.mean([getattr(r, k) for r in rows]) for k in ("axis_chi2", "wire_chi2")]
    print(f"  mean chi2: axis {means[0]:.2f} of 2, wire {means[1]:.2f} of 3")
    stick = np.array([r.stick_out_mm for r in rows])
    print(f"  stick-out: mean {np.nanmean(stick):+.3f}, largest {np.nanmax(np.abs(stick)):.3f} mm")
    print(f"  said to have moved: wire {sum(r.noticed for r in rows)}, nozzle {sum(r.nozzle_noticed for r in rows)}")
    sys.stdout.flush()


def main() -> None:
    """Measure many tools and print the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tools", type=int, default=200)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--trials", nargs="*", default=["random", "half", "straight"])
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.tools)
    with ProcessPoolExecutor(given.workers) as pool:
        trials = {"random": ("bent 0 to 5 mm, 0 to 3 deg", _random), "half": ("bent 0.5 mm", _half)}
        trials["straight"] = ("straight", _straight)
        for name, work in (trials[key] for key in given.trials):
            _said(name, list(pool.map(work, seeds, chunksize=5)))


if __name__ == "__main__":
    main()
