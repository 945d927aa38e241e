"""Plans the groove's root for a robot in any mounting: in a frame whose z points up, and back in the base."""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.workpieces.part import WeldPart
from weldcal.welding.locate.planning import PlanningMethod, RootPlan, plan_root

_Z = (0.0, 0.0, 1.0)


def plan_root_anyhow(
    points_B: npt.NDArray[np.floating],
    workpiece: WeldPart,
    X_BP_guess: RigidTransform,
    method: PlanningMethod,
    eye_B: npt.NDArray[np.float64],
    up_B: npt.NDArray[np.float64],
    plan: Callable[..., RootPlan] = plan_root,
) -> RootPlan:
    """`plan_root` where up_B (3,), the direction against gravity in the base, may differ from the base's z.

    Finding a part takes up for +z: the scan is turned about the base's origin, and the result is turned back.

    Raises:
        WeldcalError: as plan_root.
    """
    if tuple(up_B) == _Z:
        return plan(points_B, workpiece, X_BP_guess, method, eye_B)
    R_BU = RotationMatrix.MakeFromOneVector(up_B, 2)
    X_UB = RigidTransform(R_BU.inverse(), np.zeros(3))
    if method.start_B is not None:
        x, y, z = X_UB @ np.array(method.start_B)
        method = dc.replace(method, start_B=(x, y, z))
    R_UB = X_UB.rotation().matrix()
    found = plan(points_B @ R_UB.T, workpiece, X_UB @ X_BP_guess, method, R_UB @ eye_B)
    R = R_BU.matrix()
    X_BP = None if found.X_BP is None else X_UB.inverse() @ found.X_BP
    return dc.replace(found, root=found.root @ R.T, up=found.up @ R.T, X_BP=X_BP)
