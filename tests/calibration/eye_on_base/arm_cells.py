"""Makes cells whose flange is small, far or hidden.

An arm of drawn housings, a second arm, a table and clutter, by rays.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import Chain, joint_frames, known_arms, load_arm
from weldcal.models.arms.urdf import link_solids
from weldcal.models.arrays import Array
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.mesh import TriMesh, merge, revolve
from weldcal.tools.report.render import csv_text

ARMS = ("ur3e", "ur5e", "ur10e", "ur16e", "ur20", "aubo_i5", "franka_fr3")
REACH_M = {"ur3e": 0.5, "ur5e": 0.85, "ur10e": 1.3, "ur16e": 0.9, "ur20": 1.75, "aubo_i5": 0.88, "franka_fr3": 0.85}
FLANGES = {"ur20": "iso9409-1-80-6-m8"}
WIDTH, HEIGHT, FOCAL = 640, 480, 640.0  # pixels
SCANS = 8
START_M, RIGHT_M = 0.06, 0.003  # largest error at the work point of a right start, and of a right calibration
START_SCANS = 3
_DRAWN: dict[str, list[tuple[int, str, tuple[float, float], float, float, float]]] = {
    "aubo_i5": [
        (0, "z", (0.0, 0.0), 0.0, 0.05, 0.085),
        (1, "z", (0.0, 0.0), -0.078, 0.072, 0.06),
        (2, "z", (0.0, 0.0), -0.059, 0.102, 0.061),
        (2, "z", (0.408, 0.0), -0.059, 0.102, 0.061),
        (2, "x", (0.0, 0.022), 0.0, 0.408, 0.057),
        (3, "z", (0.0, 0.0), 0.042, 0.14, 0.057),
        (3, "x", (0.0, 0.1), 0.0, 0.376, 0.038),
        (3, "z", (0.376, 0.0), 0.042, 0.162, 0.039),
        (4, "z", (0.0, 0.0), -0.048, 0.039, 0.039),
        (4, "y", (0.0, 0.0), -0.06, 0.06, 0.038),
        (5, "z", (0.0, 0.0), -0.048, 0.039, 0.039),
        (5, "y", (0.0, 0.0), -0.056, 0.06, 0.038),
        (6, "z", (0.0, 0.0), -0.04, -0.012, 0.037),
    ],
    "franka_fr3": [
        (0, "z", (-0.03, 0.0), 0.0, 0.14, 0.09),
        (1, "z", (0.0, 0.0), -0.192, 0.05, 0.055),
        (1, "y", (0.0, 0.0), -0.129, 0.055, 0.055),
        (2, "z", (0.0, 0.0), -0.05, 0.129, 0.055),
        (2, "y", (0.0, 0.0), -0.194, 0.05, 0.055),
        (3, "z", (0.0, 0.0), -0.121, 0.05, 0.055),
        (3, "x", (0.0, 0.0), 0.0, 0.0825, 0.055),
        (3, "y", (0.0, 0.0825), -0.055, 0.111, 0.055),
        (4, "z", (0.0, 0.0), -0.055, 0.111, 0.055),
        (4, "x", (0.0, 0.0), -0.0825, 0.0, 0.055),
        (4, "y", (0.0, -0.0825), -0.05, 0.124, 0.055),
        (5, "z", (0.0, 0.0), -0.264, -0.17, 0.055),
        (5, "z", (0.0, 0.07), -0.19, 0.04, 0.055),
        (5, "y", (0.0, 0.0), 0.0, 0.07, 0.05),
        (6, "x", (0.0, 0.0), -0.048, 0.132, 0.046),
        (6, "y", (0.0, 0.088), -0.05, 0.082, 0.044),
        (7, "z", (0.0, 0.0), 0.052, 0.095, 0.044),
        (7, "z", (0.045, 0.045), 0.06, 0.1, 0.03),
    ],
}
"""Cylinders of arms without drawings: link, axis, the line's place in the other two coordinates (z, x for y), from, to,
radius, m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmCell:
    """Hold a cell and its scans.

    Its arm, the true pose of the scanner X_BC, joints (n, k) rad, scans (H, W, 3) m with NaN, and the flange's
    designation.
    """

    arm: str
    flange: str
    X_BC: RigidTransform
    X_BF: tuple[RigidTransform, ...]
    q: Array
    clouds: tuple[Array, ...]


def _frames(chain: Chain, q: Array) -> list[Array]:
    """Poses (4, 4) of base, links and flange in B."""
    frames = [np.eye(4), *joint_frames(chain.stack, q)]
    return [*frames, frames[-1] @ chain.X_LF]


def _tube(a: Array, b: Array, radius: float) -> TriMesh:
    """Return a closed cylinder from a to b (3,) m."""
    d = b - a
    length = float(np.linalg.norm(d))
    mesh = revolve(np.array([(0.0, 0.0), (radius, 0.0), (radius, length), (0.0, length)]), 48)
    return mesh.transformed(RigidTransform(RotationMatrix.MakeFromOneVector(d, 2), a))


def _box(size: Array, X: RigidTransform) -> TriMesh:
    box = o3d.geometry.TriangleMesh.create_box(*size)
    return TriMesh(np.asarray(box.vertices) - 0.5 * size, np.asarray(box.triangles)).transformed(X)


def arm_links(name: str, rng: np.random.Generator) -> list[TriMesh]:
    """Make the bodies of base and links in their frames, m, with a box and a hose on them.

    They are thicker or thinner than drawn by up to 8 %.
    """
    chain = load_chain(name)
    if name in known_arms():
        arm = load_arm(name)
        links = [merge(*link_solids(arm, k)) for k in range(chain.n + 1)]
    else:
        parts: list[list[TriMesh]] = [[] for _ in range(chain.n + 1)]
        for k, axis, (u, v), low, high, radius in _DRAWN[name]:
            order = {"x": (0, 1, 2), "y": (1, 2, 0), "z": (2, 0, 1)}[axis]
            a, b = np.zeros(3), np.zeros(3)
            a[list(order)], b[list(order)] = (low, u, v), (high, u, v)
            parts[k].append(_tube(a, b, radius))
        links = [merge(*some) for some in parts]
    out = []
    for k, mesh in enumerate(links):
        middle = mesh.vertices.mean(axis=0)
        wide = 1.0 + rng.uniform(-0.08, 0.08) if k <= chain.n - 1 else 1.0
        v = middle + (mesh.vertices - middle) * wide
        mesh = TriMesh(v, mesh.triangles)
        if 2 <= k <= 3 and rng.random() < 0.5:  # a hose along the arm
            extent = np.ptp(v, axis=0)
            way, off = int(np.argmax(extent)), rng.normal(size=3)
            off[way] = 0.0
            off *= (0.5 * np.sort(extent)[0] + 0.015) / np.linalg.norm(off)
            low_end, high_end = middle + off, middle + off
            low_end[way], high_end[way] = v[:, way].min(), v[:, way].max()
            mesh = merge(mesh, _tube(low_end, high_end, 0.012))
        out.append(mesh)
    return out


def _placed(mesh: TriMesh, X: Array) -> TriMesh:
    return TriMesh(mesh.vertices @ X[:3, :3].T + X[:3, 3], mesh.triangles)


def posed(links: list[TriMesh], flange: TriMesh, frames: list[Array]) -> TriMesh:
    """Return the whole arm at these frames, in B."""
    return merge(*(_placed(m, X) for m, X in zip(links, frames[:-1], strict=True)), _placed(flange, frames[-1]))


def clutter(reach: float, eye: Array, rng: np.random.Generator) -> TriMesh:
    """Make a table with boxes, cans and discs of a flange's size on it, none within 0.2 m of B.

    And a wall that hides nothing from ``eye`` (3,) m.
    """
    table = _box(np.array([3.0 * reach, 3.0 * reach, 0.04]), RigidTransform([0.0, 0.0, -0.02 - rng.uniform(0.0, 0.05)]))
    parts = [table]
    for _ in range(int(rng.integers(3, 9))):
        p = np.array([*rng.uniform(-reach, reach, 2), 0.0])
        if np.hypot(p[0], p[1]) < 0.2:
            continue
        turn = RotationMatrix.MakeZRotation(rng.uniform(0, 2 * np.pi))
        high = rng.uniform(0.03, 0.12)
        if rng.random() < 0.5:
            size = np.array([*rng.uniform(0.05, 0.3, 2), high])
            parts.append(_box(size, RigidTransform(turn, p + np.array([0.0, 0.0, 0.5 * high]))))
        else:
            parts.append(_tube(p, p + np.array([0.0, 0.0, high]), rng.uniform(0.025, 0.06)))
    if rng.random() < 0.3:  # beyond the base as the scanner looks at it
        angle = float(np.arctan2(-eye[1], -eye[0])) + rng.uniform(-0.6, 0.6)
        away = 1.4 * reach * np.array([np.cos(angle), np.sin(angle), 0.3])
        at = RigidTransform(RotationMatrix.MakeZRotation(angle), away)
        parts.append(_box(np.array([0.03, 3.0 * reach, 2.0]), at))
    return merge(*parts)


def render(mesh: TriMesh, X_BC: RigidTransform, rng: np.random.Generator, sigma: float) -> Array:
    """Render a scan (H, W, 3) m with noise that grows with distance and slant, and flying pixels.

    It has holes where nothing came back.
    """
    u, v = np.meshgrid((np.arange(WIDTH) - 0.5 * WIDTH) / FOCAL, (np.arange(HEIGHT) - 0.5 * HEIGHT) / FOCAL)
    rays_C = np.stack([u, v, np.ones_like(u)], axis=-1)
    d = rays_C @ X_BC.rotation().matrix().T
    scene = mesh.scene
    rays = np.concatenate([np.broadcast_to(X_BC.translation(), d.shape), d], axis=-1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor.from_numpy(np.ascontiguousarray(rays)), nthreads=1)
    z = hit["t_hit"].numpy().astype(float)
    normal = hit["primitive_normals"].numpy()
    slant = np.abs((normal * d).sum(axis=-1)) / np.linalg.norm(d, axis=-1)
    z[(z > 4.0) | (z < 0.25)] = np.nan
    z[slant < 0.12] = np.nan
    z += sigma * np.square(np.where(np.isfinite(z), z, 1.0)) / np.maximum(slant, 0.3) * rng.normal(size=z.shape)
    blobs = cv2.GaussianBlur(rng.normal(size=z.shape), (0, 0), 6.0)
    z[blobs < np.quantile(blobs, rng.uniform(0.0, 0.06))] = np.nan
    z[rng.random(z.shape) < 0.01] = np.nan
    return np.asarray(rays_C * z[..., None])


def arm_cell(seed: int, scans: int = SCANS) -> ArmCell:
    """Return the cell of a seed: arm by turns, the scanner 0.6 to 1.7 m from where the flange is scanned."""
    rng = np.random.default_rng([seed, 41])
    name = ARMS[seed % len(ARMS)]
    chain, reach = load_chain(name), REACH_M[name]
    designation = FLANGES.get(name, "iso9409-1-50-4-m6")
    links, flange = arm_links(name, rng), flange_mesh(get_flange(designation), 0.012)
    while True:
        azimuth = rng.uniform(0, 2 * np.pi)
        work = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * rng.uniform(0.4, 0.65) * reach
        work[2] = rng.uniform(0.25, 0.5) * reach
        away = rng.normal(size=3)
        away[2] = abs(away[2]) + 0.2
        away[:2] += 0.8 * np.array([np.cos(azimuth), np.sin(azimuth)])
        eye = work + away / np.linalg.norm(away) * rng.uniform(0.6, 1.7)
        if eye[2] > 0.3 and np.hypot(eye[0], eye[1]) > 0.35:
            break
    z = work - eye + rng.normal(size=3) * 0.05
    R = RotationMatrix.MakeFromOneVector(z, 2) @ RotationMatrix.MakeZRotation(rng.uniform(0, 2 * np.pi))
    X_BC = RigidTransform(R, eye)
    still = clutter(reach, eye, rng)
    if rng.random() < 0.5:
        other = arm_links(name, rng)
        q = rng.uniform(np.maximum(chain.position_lower, -np.pi), np.minimum(chain.position_upper, np.pi))
        X = np.eye(4)
        X[:3, 3] = (
            work + rng.normal(size=3) * [0.2, 0.2, 0.0] + reach * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        )
        X[2, 3] = 0.0
        still = merge(still, posed(other, flange, [X @ f for f in _frames(chain, q)]))
    seen_share, sigma = rng.uniform(0.5, 1.0), rng.uniform(0.1, 0.5) * 1e-3
    joints: list[Array] = []
    poses: list[RigidTransform] = []
    clouds = []
    tries = 0
    while len(joints) < scans:
        tries += 1
        p = work + rng.uniform(-0.2, 0.2, 3) * min(reach, 1.0)
        towards = (eye - p) / np.linalg.norm(eye - p)
        tilt = rng.uniform(0.0, 55.0) if rng.random() < seen_share else rng.uniform(65.0, 120.0)
        side = np.cross(towards, rng.normal(size=3))
        z = np.cos(np.radians(tilt)) * towards + np.sin(np.radians(tilt)) * side / np.linalg.norm(side)
        turn = RotationMatrix.MakeFromOneVector(z, 2) @ RotationMatrix.MakeZRotation(rng.uniform(0, 2 * np.pi))
        near = joints[-1] if joints else 0.5 * (chain.position_lower + chain.position_upper)
        found = nearest_solution(chain, RigidTransform(turn, p), near)
        if tries > 300:
            return arm_cell(seed + 100_000 * 7)
        if found is None:
            continue
        frames = _frames(chain, found)
        if min(float(f[2, 3]) for f in frames[2:]) < 0.08:
            continue
        joints.append(found)
        poses.append(RigidTransform(RotationMatrix.ProjectToRotationMatrix(frames[-1][:3, :3]), frames[-1][:3, 3]))
        clouds.append(render(merge(posed(links, flange, frames), still), X_BC, rng, sigma))
    return ArmCell(arm=name, flange=designation, X_BC=X_BC, X_BF=tuple(poses), q=np.array(joints), clouds=tuple(clouds))


def write_cell(cell: ArmCell, folder: Path, *, joints: bool = True) -> None:
    """Write the cell's scans as a dataset without a guess, with its joint angles or without."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"q{k + 1}" for k in range(cell.q.shape[1])] if joints else []
    rows = []
    for k, (X, q) in enumerate(zip(cell.X_BF, cell.q, strict=True)):
        w = X.rotation().ToQuaternion().wxyz()
        rows.append([f"p{k:02d}", *(repr(float(v)) for v in (*X.translation(), *w, *(q if joints else ())))])
    (folder / "poses.csv").write_text(csv_text(("id", "x", "y", "z", "qw", "qx", "qy", "qz", *names), rows))
    (folder / "dataset.yaml").write_text(
        f"schema: 1\nrobot: {cell.arm}\nflange: {cell.flange}\nconfiguration: eye_on_base\nunits: {{clouds: m, poses:"
        " m}\n"
    )
    (folder / "clouds").mkdir(exist_ok=True)
    for k, cloud in enumerate(cell.clouds):
        np.savez(folder / "clouds" / f"p{k:02d}.npz", points=cloud.astype(np.float32))
