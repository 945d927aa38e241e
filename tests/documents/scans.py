"""Scans of a flange from simple geometry: a dataset that calibrates, in a tenth of a second and without a rendered
cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.calibration.flange.test_base_circle import scan
from weldcal.calibration.data.header import DatasetHeader, ScannerGuess
from weldcal.calibration.data.writing import save_dataset
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.flanges import get_flange

Floats = npt.NDArray[np.float64]

FLANGE = "iso9409-1-50-4-m6"
X_BC = RigidTransform(RollPitchYaw(np.pi - 0.02, 0.03, 0.4), [0.66, 0.02, 0.94])
NOISE_M = 5e-5
FOCAL_PX = 1500.0
WINDOW_PX = 260


def flange_scan(X_CF: RigidTransform, rng: np.random.Generator, *, holes: bool = True) -> Floats:
    """The face of a flange at a pose, seen by a pinhole camera: points (H, W, 3) m in the camera's frame, NaN beside
    it."""
    standard = get_flange(FLANGE)
    p, R = X_CF.translation(), X_CF.rotation().matrix()
    offset = np.arange(WINDOW_PX) - 0.5 * (WINDOW_PX - 1)
    v, u = np.meshgrid(offset, offset, indexing="ij")
    ray = np.stack([u / FOCAL_PX + p[0] / p[2], v / FOCAL_PX + p[1] / p[2], np.ones_like(u)], axis=-1)
    points = ray * ((R[:, 2] @ p) / (ray @ R[:, 2]))[..., None]
    local = (points - p) @ R
    rho = np.hypot(local[..., 0], local[..., 1])
    seen = (rho < standard.face_outer_radius_m) & (rho > standard.face_inner_radius_m)
    for x, y, radius in standard.openings() if holes else ():
        seen &= np.hypot(local[..., 0] - x, local[..., 1] - y) > radius
    points = points * (1.0 + NOISE_M / p[2] * rng.standard_normal(rho.shape))[..., None]
    return np.where(seen[..., None], points, np.nan)


def flange_poses(n: int, rng: np.random.Generator) -> list[RigidTransform]:
    """Poses X_CF in front of the camera: the flange looks at it, tilted by up to 30 degrees and turned by any angle."""
    poses = []
    for _ in range(n):
        tilt = RollPitchYaw(*rng.uniform(-0.5, 0.5, 2), 0.0).ToRotationMatrix()
        faces = RotationMatrix.MakeXRotation(np.pi) @ RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        poses.append(RigidTransform(tilt @ faces, rng.uniform([-0.12, -0.1, 0.55], [0.12, 0.1, 0.75])))
    return poses


def write_scans(folder: Path, n: int, seed: int, *, scale: float = 1.0, holes: bool = True) -> Path:
    """A dataset of n scans, pose01 and so on, of a scanner at X_BC that measures ``scale`` times what is true."""
    rng = np.random.default_rng(seed)
    poses = {f"pose{k + 1:02d}": X_CF for k, X_CF in enumerate(flange_poses(n, rng))}
    header = DatasetHeader(schema=1, robot="ur10e", flange=FLANGE, scanner="phoxi_m", configuration="eye_on_base")
    header.scanner_guess = ScannerGuess(xyz=[0.65, 0.0, 0.95], wxyz=X_BC.rotation().ToQuaternion().wxyz().tolist())
    clouds = {id: scale * flange_scan(X_CF, rng, holes=holes) for id, X_CF in poses.items()}
    save_dataset(folder, header, {id: X_BC @ X_CF for id, X_CF in poses.items()}, clouds)
    _add_joints(folder / "poses.csv", list(poses.values()))
    return folder


def _add_joints(path: Path, poses: list[RigidTransform]) -> None:
    """Add the columns q1 to q6 (rad) of a UR10e; the poses are within its reach."""
    arm, (header, *rows) = load_arm("ur10e"), path.read_text().splitlines()
    angles = [inverse_kinematics(arm, X_BC @ X_CF)[0] for X_CF in poses]
    lines = [",".join([header, *(f"q{k}" for k in range(1, 7))])]
    lines += [",".join([row, *(f"{angle:.9f}" for angle in q)]) for row, q in zip(rows, angles, strict=True)]
    path.write_text("\n".join(lines) + "\n")


X_FC = RigidTransform(RollPitchYaw(0.02, -0.015, 0.01), [0.008, -0.095, 0.064])
WRIST_POSES = (  # joints, degrees, from which a scanner on the wrist sees the foot
    (-80.8, -76.1, 69.0, -38.3, -99.8, 27.2),
    (-0.3, -78.3, 83.7, -56.7, -102.8, -113.5),
    (44.5, -85.3, 57.2, -24.0, -88.2, 15.5),
    (-137.1, -102.2, 119.9, -55.0, -103.5, -25.1),
    (-78.0, -177.6, 57.3, -11.6, -110.6, -8.6),
    (98.4, -76.1, 82.0, -34.4, -109.1, -80.8),
    (-66.6, -86.1, 92.7, -38.0, -97.6, -70.6),
    (-17.2, -72.4, 50.3, -29.0, -111.7, -71.0),
    (-76.7, -74.9, 41.8, -21.7, -88.7, 38.5),
)


def write_wrist_scans(folder: Path, scale: float = 1.0) -> Path:
    """A dataset of a scanner on the wrist, at X_FC, that sees the foot of a UR10e; it measures ``scale`` times what is
    true."""
    arm = load_arm("ur10e")
    poses = {f"pose{k + 1:02d}": forward_kinematics(arm, np.radians(q)) for k, q in enumerate(WRIST_POSES)}
    header = DatasetHeader(schema=1, robot="ur10e", flange=FLANGE, scanner="phoxi_m", configuration="eye_in_hand")
    header.scanner_guess = ScannerGuess(xyz=[0.0, -0.1, 0.06])
    clouds = {id: scale * scan(X @ X_FC, 1e-4, size=(824, 616), seed=k) for k, (id, X) in enumerate(poses.items())}
    save_dataset(folder, header, poses, clouds)
    return folder
