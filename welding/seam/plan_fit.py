"""Registers the plan rigidly to the tactile points: source of tangents, of the preview and of the path through gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.welding.numerics import Array, pose, unit
from weldcal.welding.seam.curve import SeamCurve


@dataclass(frozen=True)
class PlanFitConfig:
    """Weights of the plan's registration to the tactile points.

    The along-track shift is unobservable on a straight seam, so a prior holds it; correlated neighbours count as one
    point.

    Attributes:
        window_m: length of the newest tactile points used.
        spacing_m: distance between the points used.
        correlation_m: length of seam that counts as one independent measurement (the plan's warp is smooth).
        sigma_m: sigma of a point about the moved plan.
        prior_angle_rad, prior_shift_m: one sigma of the plan's pose error.
    """

    window_m: float = 0.150
    spacing_m: float = 2.0e-3
    correlation_m: float = 8.0e-3
    sigma_m: float = 0.3e-3
    prior_angle_rad: float = math.radians(1.0)
    prior_shift_m: float = 3.0e-3


@dataclass(frozen=True)
class PlanFit:
    """A plan and the motion (angle about its up-normal, shift) that registers it to the tactile points.

    Attributes:
        plan: the tip line as planned, in B.
        curve: the same, moved.
        parameters: (4,) angle rad, then shift m in B along the two in-plane axes and up.
        points: (m,3) tactile points used; s: (m,) m their arc lengths on the plan.
    """

    plan: SeamCurve
    curve: SeamCurve
    parameters: Array = field(default_factory=lambda: np.zeros(4))
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    s: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def start(cls, plan: SeamCurve) -> PlanFit:
        """The fit before any tactile point: the plan unmoved."""
        return cls(plan, plan)


def plan_motion(plan: SeamCurve, parameters: Array) -> RigidTransform:
    """The rigid motion of the plan in B for parameters (4,), with its rotation about the plan's middle."""
    axes, pivot = _axes(plan)
    c, s = math.cos(parameters[0]), math.sin(parameters[0])
    turn = axes.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ axes
    return pose(turn, pivot - turn @ pivot + axes.T @ parameters[1:])


def add_point(fit: PlanFit, point: Array, s_near: float, config: PlanFitConfig) -> PlanFit:
    """The fit after one more tactile point (3,) m near plan arc s_near; unchanged when too close to the last."""
    if len(fit.points) and float(np.linalg.norm(point - fit.points[-1])) < config.spacing_m:
        return fit
    keep = math.ceil(config.window_m / config.spacing_m)
    points = np.vstack([fit.points, point])[-keep:]
    s = np.append(fit.s, s_near)[-keep:]
    return _solve(replace(fit, points=points, s=s), config)


def _axes(plan: SeamCurve) -> tuple[Array, Array]:
    """Rows e1, e2, up of the plan's plane, and its middle, (3,3) and (3,)."""
    frame = plan.frame(0.5 * plan.length)
    up = unit(plan.ups.mean(axis=0), frame.up)
    e1 = unit(frame.tangent - (frame.tangent @ up) * up, frame.tangent)
    return np.stack([e1, np.cross(up, e1), up]), frame.position


def _solve(fit: PlanFit, config: PlanFitConfig) -> PlanFit:
    axes, pivot = _axes(fit.plan)
    pivot = pivot + axes.T @ fit.parameters[1:]
    curve, s, total = fit.curve, fit.s, fit.parameters
    for _ in range(2):
        tangent = curve.tangent(s)
        s = s + np.sum((fit.points - curve.position(s)) * tangent, axis=1)
    tangent, up = curve.tangent(s), curve.up(s)
    normal = np.cross(up, tangent)
    q = curve.position(s)
    gap = fit.points - q
    lever = np.cross(axes[2], q - pivot)
    rows = [np.column_stack([np.sum(v * lever, axis=1), v @ axes.T]) for v in (normal, up)]
    a = np.vstack(rows)
    r = np.concatenate([np.sum(gap * normal, axis=1), np.sum(gap * up, axis=1)])
    length = max(config.correlation_m, len(s) * config.spacing_m)
    share = length / config.correlation_m / len(s)
    # Huber at two sigma, once per call: the next point's call is the next iteration.
    robust = np.minimum(1.0, 2.0 * config.sigma_m / np.maximum(np.abs(r), 1e-9))
    w = share * robust / config.sigma_m**2
    prior = 1.0 / np.array([config.prior_angle_rad, *([config.prior_shift_m] * 3)]) ** 2
    step = np.linalg.solve(a.T @ (w[:, None] * a) + np.diag(prior), a.T @ (w * r) - prior * total)
    total = total + step
    return replace(fit, curve=fit.plan.transformed(plan_motion(fit.plan, total)), parameters=total, s=s)
