"""One scan that shows the holes gives the scanner's whole pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.calibration.eye_on_base.test_joint_fit import X_BC as CELL_X_BC
from tests.calibration.eye_on_base.test_joint_fit import _cell
from tests.calibration.flange.face import face_points
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.few_poses import axis_turn, calibrate_from_few, estimate_from_whole_poses
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.holes import HolePattern, find_holes
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.geometry.se3 import exp_rotation, rotation_vector
from weldcal.models.flanges import get_flange

STANDARD = get_flange("iso9409-1-50-4-m6")
X_BC = RigidTransform(RollPitchYaw(3.0, 0.1, 0.5), [-0.6, -0.2, 1.3])
TURN = np.radians(0.9)


def _observations(n: int) -> tuple[list[Observation], dict[str, HolePattern]]:
    """Scans of a flange whose holes are drilled 0.9 degrees off the robot's flange frame."""
    rng = np.random.default_rng(2)
    observations, patterns = [], {}
    for k in range(n):
        R = RollPitchYaw(np.pi + 0.1 * k, 0.1, 0.7 * k).ToRotationMatrix()
        X_CR = RigidTransform(R, [0.05 * k - 0.04, 0.02, 0.5 + 0.03 * k])
        p = face_points(STANDARD, 0.0004)
        p = p + 3e-5 * rng.standard_normal(p.shape)
        drilled = X_CR @ RigidTransform(RotationMatrix.MakeZRotation(TURN), np.zeros(3))
        points = (drilled @ p.T).T
        fit = fit_flange(points, STANDARD)
        pattern = find_holes(points, fit, STANDARD)
        assert pattern is not None
        observations.append(observation_from_fit(f"p{k}", X_BC @ X_CR, fit))
        patterns[f"p{k}"] = pattern
    return observations, patterns


def test_one_scan_is_enough_where_the_turn_of_the_holes_is_known() -> None:
    observations, patterns = _observations(3)
    turn, spread = axis_turn(observations, patterns, X_BC)
    assert turn == pytest.approx(TURN, abs=np.radians(0.1))
    assert spread < np.radians(0.1)
    one = estimate_from_whole_poses(observations[:1], patterns, turn)
    three = estimate_from_whole_poses(observations, patterns, turn)
    # at the flange a centre's noise is left; 0.1 degrees of turn over 0.1 m would be 0.17 mm at another place
    for X, limit in ((one.X_BC, 3e-4), (three.X_BC, 1.5e-4)):
        error = [np.linalg.norm(X @ o.p_CR - o.p_BR) for o in observations]
        assert max(error) < limit
    assert three.ids == ("p0", "p1", "p2")


def test_scans_without_holes_are_refused() -> None:
    observations, _ = _observations(1)
    with pytest.raises(TooFewPoses, match="holes"):
        estimate_from_whole_poses(observations, {})


@pytest.mark.parametrize("turn_deg", [179.99, -179.99, 90.0])
def test_a_turn_near_half_a_circle_does_not_wrap(turn_deg: float) -> None:
    """Some turns of one flange read +180 and others -180 degrees."""
    observations, patterns = _observations(4)
    turned = RotationMatrix.MakeZRotation(TURN - np.radians(turn_deg))
    observations = [replace(o, X_BR=o.X_BR @ RigidTransform(turned, np.zeros(3))) for o in observations]
    turn, spread = axis_turn(observations, patterns, X_BC)
    assert abs(np.angle(np.exp(1j * (turn - np.radians(turn_deg))))) < np.radians(0.1)
    assert spread < np.radians(0.1)


def test_a_rotation_that_the_holes_leave_open_is_not_used() -> None:
    observations, patterns = _observations(3)
    quarter = tuple(np.radians([90.0, 180.0, -90.0]))
    patterns["p1"] = replace(patterns["p1"], other_turns_rad=quarter)
    assert estimate_from_whole_poses(observations, patterns, TURN).ids == ("p0", "p2")
    patterns = {k: replace(p, other_turns_rad=quarter) for k, p in patterns.items()}
    with pytest.raises(TooFewPoses, match=r"dowel hole\. .* one of 0, 90, 180, 270 degrees"):
        estimate_from_whole_poses(observations, patterns, TURN)


@pytest.mark.parametrize(("n", "holes"), [(1, True), (3, True), (3, False)])
def test_the_region_of_few_scans_holds_what_they_cannot_show_of_the_scanner(n: int, holes: bool) -> None:
    """Scanners off by what is usual: scale 0.2 %, gradient 0.15 % per 100 mm, bends 0.1 % at the image's edge, 0.4 m
    away."""
    squares, alone = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        edge = 0.35 * 0.4
        bend = tuple(1e-3 / edge**2 * rng.standard_normal(3))
        gx, gy = 1.5e-2 * rng.standard_normal(2)
        observations, patterns = _cell(
            ScannerCorrection(1.0 + 2e-3 * rng.standard_normal(), (gx, gy), bend), n=n, seed=seed
        )
        for o in observations:
            R = patterns[o.id].X_CR.rotation().matrix()
            R = (
                exp_rotation(np.cross(R[:, 2], o.n_C))
                @ R
                @ exp_rotation(np.array([0.0, 0.0, 1e-3 * rng.standard_normal()]))
            )
            X_CR = RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), o.p_CR)
            patterns[o.id] = replace(patterns[o.id], X_CR=X_CR, holes_C=np.zeros((5, 3)))
        e = calibrate_from_few(observations, patterns, 0.0 if holes else None)
        turn = rotation_vector(CELL_X_BC.rotation() @ e.X_BC.rotation().inverse())
        off = np.concatenate([turn, CELL_X_BC.translation() - e.X_BC.translation()])
        assert e.joint is not None
        squares.append(off @ np.linalg.solve(e.covariance, off) / 6.0)
        # what the region was without the scanner's part
        closed = e.covariance - e.joint[:6, 6:] @ np.linalg.solve(e.joint[6:, 6:], e.joint[6:, :6])
        alone.append(off @ np.linalg.solve(closed, off) / 6.0)
    # 360 squares know their mean to 0.08; the usual spread of robot and scanner is larger than this cell's noise
    assert 0.42 < np.mean(squares) < 1.15
    assert np.mean(alone) > 3.0 * np.mean(squares)
