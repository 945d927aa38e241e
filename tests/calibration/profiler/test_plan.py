"""Planned poses of a profiler: what is open is closed first, and a few chosen ones are worth many at random."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.worlds.edge_trials import edge_crb
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.plan import (
    Field,
    plan_edge_poses,
    plan_sphere_poses,
    sample_edge_poses,
    sample_sphere_poses,
)
from weldcal.models.errors import InputError

SIGMAS = {"sigma_robot_m": 3e-5, "sigma_xz_m": (5e-5, 6e-5)}
STATE = EdgeState(
    Rotation.from_euler("xyz", [170.0, -9.0, 52.0], degrees=True).as_matrix(),
    np.array([0.055, 0.021, 0.130]),
    np.array([0.9, -0.2, 0.25]),
    np.array([0.8, 0.58, 0.15]) / np.linalg.norm([0.8, 0.58, 0.15]),
)


def field_rms(X: FlangePoses) -> float:
    """By the bound of the estimator itself, not by the planner's own matrices."""
    C = edge_crb(STATE, X.rotation, X.translation, sigma_robot_m=3e-5, sigma_xz_m=(5e-5, 6e-5))
    total = 0.0
    for x, z in Field().points:
        v = STATE.rotation @ np.array([x, 0.0, z])
        J = np.hstack([-np.cross(np.eye(3), v), np.eye(3)])
        total += float(np.trace(J @ C @ J.T))
    return float(np.sqrt(total / len(Field().points)))


def both(a: FlangePoses, b: FlangePoses) -> FlangePoses:
    return FlangePoses(np.concatenate([a.rotation, b.rotation]), np.concatenate([a.translation, b.translation]))


def test_eight_chosen_edge_poses_are_worth_more_than_eight_at_random_and_the_forecast_holds() -> None:
    first, many = sample_edge_poses(STATE, 8, 1), sample_edge_poses(STATE, 150, 2)
    plan = plan_edge_poses(STATE, first, many, 8, **SIGMAS)  # type: ignore[arg-type]
    planned = both(first, many[np.array(plan.chosen)])
    assert len(set(plan.chosen)) == 8
    assert (np.diff(plan.rms_m) < 0.0).all()
    assert plan.rms_m[-1] == pytest.approx(field_rms(planned), rel=0.02)
    random = [field_rms(both(first, sample_edge_poses(STATE, 8, 10 + k))) for k in range(12)]
    assert plan.rms_m[-1] < min(random)


def test_what_one_axis_of_turning_left_open_is_closed_by_the_first_pose() -> None:
    first = sample_edge_poses(STATE, 1, 3)
    turns = [Rotation.from_rotvec(a * STATE.rotation[:, 2]).as_matrix() for a in np.linspace(-0.5, 0.5, 12)]
    R = np.array([first.rotation[0] @ T for T in turns])
    v = STATE.rotation @ np.array([0.0, 0.0, 0.076]) + STATE.translation
    stuck = FlangePoses(R, STATE.point + np.linspace(-0.03, 0.03, 12)[:, None] * STATE.direction - R @ v)
    plan = plan_edge_poses(STATE, stuck, sample_edge_poses(STATE, 80, 4), 3, **SIGMAS)  # type: ignore[arg-type]
    assert plan.rms_m[0] > 1e-3
    assert plan.rms_m[3] < 0.05 * plan.rms_m[0]


def test_candidates_that_see_nothing_are_not_chosen() -> None:
    first, far = sample_edge_poses(STATE, 8, 1), sample_edge_poses(STATE, 20, 5)
    away = FlangePoses(far.rotation, far.translation + np.array([0.0, 0.0, 0.5]))
    with pytest.raises(InputError, match="0 see the object"):
        plan_edge_poses(STATE, first, away, 2, **SIGMAS)  # type: ignore[arg-type]


def test_sphere_poses_are_chosen_likewise() -> None:
    R, t, c = STATE.rotation, STATE.translation, np.array([0.9, -0.2, 0.25])
    first, many = sample_sphere_poses(R, t, c, 0.02, 6, 1), sample_sphere_poses(R, t, c, 0.02, 80, 2)
    plan = plan_sphere_poses(R, t, c, 0.02, first, many, 6)
    at_random = [
        plan_sphere_poses(R, t, c, 0.02, both(first, sample_sphere_poses(R, t, c, 0.02, 6, 10 + k)), many, 1).rms_m[0]
        for k in range(8)
    ]
    assert (np.diff(plan.rms_m) < 0.0).all()
    assert plan.rms_m[-1] < min(at_random)
