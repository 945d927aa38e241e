"""Computes where a simulated arm with kinematic errors reports the work point, the reference of a calibration's error."""

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.rigid import fit_rigid
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array


def true_work_point(
    arm: ArmModel,
    true_arm: ArmModel,
    X_FT: RigidTransform | None,
    p_BWork: Array,
    q_home: Array,
    poses: Sequence[Array],
) -> Array:
    """The place (3,) m in the true base that the arm reports as the work point (3,) m.

    With a tool: where its tip is when it is reported there, upright as at ``q_home`` (6,) rad. Without one no posture
    belongs to the work point: it is mapped by the rigid transform that fits the true to the reported flange positions of
    the calibration ``poses`` (n, 6) rad best.
    """
    if X_FT is not None:
        p_FT = np.asarray(X_FT.translation())
        R = forward_kinematics(arm, q_home).rotation()
        q = nearest_solution(arm, RigidTransform(R, p_BWork - R.multiply(p_FT)), q_home)
        if q is not None:
            shift = forward_kinematics(true_arm, q).multiply(p_FT) - forward_kinematics(arm, q).multiply(p_FT)
            return np.asarray(p_BWork + shift)
    reported, true = (np.array([forward_kinematics(a, q).translation() for q in poses]) for a in (arm, true_arm))
    return np.asarray(fit_rigid(true, reported).multiply(p_BWork))
