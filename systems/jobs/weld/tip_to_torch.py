"""Predicts how far errors of the arm put the torch off the seam that the tip has felt.

At one place of a bent seam the torch is led by another posture of the arm than the tip was: it comes a chord later, and
the tool has turned. What the arm's kinematics are off is not the same in both, and the tip cannot feel the difference.
Derivation in docs/parts.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import flange_poses
from weldcal.calibration.refinement.kinematics_fit import FactoryPrior
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.tool import WeldingTool
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import DeflectionControl, ServoConfig, ToolGeometry
from weldcal.welding.servo.tool_axes import tool_path

EVERY = 10  # places of the tool's path: 10 mm of tip and torch together
_UNPRESSED_M = 1e-9  # stands for a tip that is not pressed: zero has no direction
_DIFFERENCE = 1e-2  # of the prior's standard deviation: micrometres


@dataclass(frozen=True)
class TipToTorch:
    """Between tip and torch at the same place of a seam.

    ``sigma_m``, rms over the seam of the torch's distance from the line that the tip felt, m, for arms of one accuracy;
    ``turn_rad``, the largest turn of the tool.
    """

    sigma_m: float
    turn_rad: float


def tip_to_torch(
    arm: ArmModel,
    tool: WeldingTool,
    seam: SeamCurve,
    q_near: Array,
    stated: Mapping[str, Any] | None = None,
    prior: FactoryPrior | None = None,
) -> TipToTorch:
    """Predict the error that an arm brings in between tip and torch; NaN where it does not reach the whole seam.

    Args:
        seam: line of the seated tip in B.
        q_near: (6,) rad, of the posture in which the arm welds.
        stated: what a refinement states of the errors that it has found (Refinement.arm_errors); without it the arm is
            as makers leave it.
        prior: how makers leave it.
    """
    at = _held(arm, tool, seam, q_near)
    if at is None:
        return TipToTorch(math.nan, math.nan)
    s_torch, s_tip, X_BT, q = at
    by_tip, by_torch = _sensitivities(arm, tool, q, prior or FactoryPrior())
    here = (s_torch >= 0.0) & (s_torch <= seam.length)
    felt = np.stack([[np.interp(s_torch[here], s_tip, row) for row in rows] for rows in by_tip.transpose(1, 2, 0)])
    off = by_torch[here] - felt.transpose(2, 0, 1)
    t = seam.tangent(s_torch[here])
    off = off - t[:, :, None] * np.einsum("ni,nik->nk", t, off)[:, None]
    sigma = np.sqrt(np.einsum("nik,kl,nil->n", off, _covariance(6 * len(arm.stack), stated), off))
    turns = [_turn(X_BT[k], X_BT[int(np.argmin(np.abs(s_tip - s_torch[k])))]) for k in np.flatnonzero(here)]
    return TipToTorch(float(np.sqrt(np.mean(sigma**2))), max(turns))


def torch_sigma(arm: ArmModel, tool: WeldingTool, seam: SeamCurve, q_near: Array) -> float:
    """The largest standard deviation m, across a seam, of where an arm as its maker leaves it puts the torch.

    NaN out of its reach.
    """
    at = _held(arm, tool, seam, q_near)
    if at is None:
        return math.nan
    s_torch, _, _, q = at
    across = np.einsum("ni,nik->nk", seam.normal(s_torch), _sensitivities(arm, tool, q, FactoryPrior())[1])
    return float(np.linalg.norm(across, axis=1)[(s_torch >= 0.0) & (s_torch <= seam.length)].max())


def _held(
    arm: ArmModel, tool: WeldingTool, seam: SeamCurve, q_near: Array
) -> tuple[Array, Array, list[RigidTransform], Array] | None:
    """Arcs (n,) of torch and tip, poses of T and joints (n, 6), with both ends of the tool on the line."""
    geometry = ToolGeometry(torch_offset_m=tool.chord_m, torch_clearance_m=0.0)
    unpressed = DeflectionControl(delta_d_m=_UNPRESSED_M, axial_d_m=_UNPRESSED_M)
    path = tool_path(seam, ServoConfig(tool=geometry, deflection=unpressed))
    rows, joints, q = [*range(0, len(path.time) - 1, EVERY), len(path.time) - 1], [], q_near
    for k in rows:
        found = nearest_solution(arm, path.X_BT[k] @ tool.X_FT.inverse(), q)
        if found is None:
            return None
        q = found
        joints.append(found)
    return path.s_torch[rows], path.s_tip[rows], [path.X_BT[k] for k in rows], np.array(joints)


def _sensitivities(arm: ArmModel, tool: WeldingTool, q: Array, prior: FactoryPrior) -> tuple[Array, Array]:
    """Displacement (n, 3, k) m of tip and of torch by each error of the links, of one standard deviation."""
    scale = np.tile([prior.turn_rad, prior.turn_rad, prior.offset_rad, *[prior.length_m] * 3], arm.n)
    p_FT, p_FW = tool.X_FT.translation(), tool.X_FT @ tool.p_TW
    columns: tuple[list[Array], list[Array]] = ([], [])
    for k in range(6 * arm.n):
        error = np.zeros(6 * arm.n)
        error[k] = _DIFFERENCE * scale[k]
        more, less = (flange_poses(arm, q, e.reshape(-1, 6)) for e in (error, -error))
        change = (more - less) / (2.0 * _DIFFERENCE)
        for found, p in zip(columns, (p_FT, p_FW), strict=True):
            found.append(change[:, :3, :3] @ p + change[:, :3, 3])
    by_tip, by_torch = (np.stack(found, axis=2) for found in columns)
    return by_tip, by_torch


def _covariance(size: int, stated: Mapping[str, Any] | None) -> Array:
    """Covariance (k, k) of the links' errors in units of the prior.

    One where nothing was found, else as it is stated.
    """
    covariance = np.eye(size)
    if stated is not None:
        which = np.array(stated["which"], dtype=int)
        found = np.array(stated["covariance"], dtype=float)[-len(which) :, -len(which) :]
        covariance[np.ix_(which, which)] = found
    return covariance


def _turn(a: RigidTransform, b: RigidTransform) -> float:
    return float((a.rotation().inverse() @ b.rotation()).ToAngleAxis().angle())
