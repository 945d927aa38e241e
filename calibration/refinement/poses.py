"""Chooses the poses whose scans tell most about camera, scanner and arm together."""

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import flange_poses, inverse
from weldcal.calibration.refinement.kinematics_fit import KinematicsFit, arm_errors
from weldcal.models.arms.chain import Chain
from weldcal.models.arrays import Array

_POSITION_M, _NORMAL_RAD = 1e-4, 1e-3  # what arms and scanners leave of a scan
_POSE_SIGMA, _FACTOR_SIGMA = (
    10.0,
    0.1,
)  # of X_BC (rad, m) and the scanner's factors before any scan: next to nothing is known


def informative_poses(arm: Chain, X_BC: RigidTransform, q: Array, n: int, kind: str = "links") -> NDArray[np.int64]:
    """Indices (n,) of those joint angles q (m, joints) rad, of flange poses that the scanner sees, to scan for
    `--refine`.

    Greedy: each next pose lowers the expected squared position error over all m poses most (V-optimal design, Atkinson,
    Donev and Tobias 2007, 10.6). The first ones say most.
    """
    stated = flange_poses(arm, q, np.zeros((arm.n, 6)))
    seen = inverse(np.asarray(X_BC.GetAsMatrix4())) @ stated
    sought = arm_errors(arm, kind)
    k = len(sought.which)
    fit = KinematicsFit(
        X_BC=X_BC,
        correction=ScannerCorrection(),
        u=np.zeros(k),
        covariance=np.eye(1),
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=sought,
    )
    scans = [
        Observation(
            str(i), RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), X[:3, 3]), c[:3, 3], c[:3, 2]
        )
        for i, (X, c) in enumerate(zip(stated, seen, strict=True))
    ]
    J = fit.sensitivity(scans, q)
    wanted = np.einsum("nij,nik->jk", J[:, :3], J[:, :3])
    J = J / np.repeat([_POSITION_M, _NORMAL_RAD], 3)[:, None]
    terms = J.shape[2] - 6 - k
    V = np.diag(np.concatenate([np.full(6, _POSE_SIGMA**2), np.full(terms, _FACTOR_SIGMA**2), np.ones(k)]))
    chosen: list[int] = []
    for _ in range(min(n, len(q))):
        JV = J @ V
        own = np.linalg.inv(np.eye(6) + JV @ np.swapaxes(J, 1, 2))
        gain = np.einsum("nij,nji->n", own, JV @ wanted @ np.swapaxes(JV, 1, 2))
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        V = V - JV[best].T @ own[best] @ JV[best]
        V = 0.5 * (V + V.T)
    return np.array(chosen)
