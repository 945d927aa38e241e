"""Section 4.2's time-of-flight case: all pairs, held-out truth, and what the paper's compensation does to the pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.calibration.eye_on_base.validation import k_fold, position_errors
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.pipeline import all_pairs

Array = NDArray[np.float64]

PAPER_E_RPY_DEG = (-0.15, 0.92, 1.56)
PAPER_E_XYZ_MM = (-11.11, 3.90, 7.15)
"""Section 4.2: e_icp of all data points."""


@dataclass(frozen=True, eq=False)
class KinectOutcome:
    """Errors (m) at the wrist ring: ``residual`` of the all-pairs SVD, ``held_out`` of it and ``ours`` of the robust fit in 5 folds,
    ``compensated`` of H e with the paper's own e (Eq. (21)); ``shift_m`` how far that e moves the middle of the workspace, and
    ``at_camera_m`` its translation, taken at the camera."""

    name: str
    n: int
    residual: Array
    held_out: Array
    ours: Array
    compensated: Array
    shift_m: float
    at_camera_m: float


def paper_error() -> RigidTransform:
    """The e of section 4.2 as a transform."""
    return RigidTransform(RollPitchYaw(*np.radians(PAPER_E_RPY_DEG)), 1e-3 * np.array(PAPER_E_XYZ_MM))


def study_kinect(name: str, pairs: list[Observation], *, repeats: int, seed: int) -> KinectOutcome:
    """All of section 4.2 that centre pairs allow: its verification cloud is not among them, so e itself is the paper's."""
    X, e = all_pairs(pairs), paper_error()
    rng = np.random.default_rng(seed)
    held_out = []
    for _ in range(repeats):
        order = rng.permutation(len(pairs))
        for f in range(5):
            test = set(order[f::5].tolist())
            Xf = all_pairs([o for i, o in enumerate(pairs) if i not in test])
            held_out.append(position_errors(Xf, [pairs[i] for i in sorted(test)]))
    ours = k_fold(pairs, folds=5, repeats=repeats, seed=seed)
    middle = np.mean([o.p_CR for o in pairs], axis=0)
    return KinectOutcome(
        name,
        len(pairs),
        position_errors(X, pairs),
        np.concatenate(held_out),
        ours[np.isfinite(ours)],
        position_errors(X @ e, pairs),
        float(np.linalg.norm(e @ middle - middle)),
        float(np.linalg.norm(e.translation())),
    )
