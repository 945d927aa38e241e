"""Errors of an arm are found in planned scans, refused where nothing shows them, and come back as a kinematics file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.wrong_models import WrongArmStation, judged, station, study_station
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.hand_eye.joints import flange_poses
from weldcal.calibration.refinement.kinematics_choice import KinematicsChoice, choose_kinematics, kinematics_text
from weldcal.calibration.refinement.kinematics_fit import (
    KinematicsFit,
    arm_errors,
    fit_kinematics,
    informative_poses,
    unsought,
)
from weldcal.models.arms.chain import load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

ARM = load_chain("ur10e")


def _choice(world: WrongArmStation, kind: str) -> KinematicsChoice:
    estimate = estimate_eye_on_base(world.observations, SolveConfig(leave_one_out=False))
    return choose_kinematics(world.observations, world.q, ARM, kind, {}, estimate)


def test_planned_scans_find_factory_size_errors_and_state_what_remains() -> None:
    found = judged([study_station(station(40 + k)) for k in range(4)])
    assert found["ratio"] < 0.45
    # 100 scans of four worlds that share their errors
    assert 88.0 < found["inside_95_percent"] <= 100.0
    assert found["offsets_within_3_sigma_percent"] >= 95.0


def test_offsets_alone_state_what_unfitted_links_do_to_them() -> None:
    """An arm whose axes are off besides its zeros: without the prior of the links the offsets would be stated far too
    well."""
    world = station(46)
    X_BC, plain = _near(world)
    sought = arm_errors(ARM, "joints")
    bare = fit_kinematics(world.observations, world.q, sought, X_BC, plain)
    honest = fit_kinematics(world.observations, world.q, sought, X_BC, plain, considered=unsought(ARM, "joints"))
    np.testing.assert_allclose(honest.values, bare.values)
    off = np.abs(honest.values - world.errors.ravel()[sought.which])
    assert (off < 3.0 * honest.sigma).all()
    assert (honest.sigma > 1.2 * bare.sigma).all()
    assert unsought(ARM, "links") is None


def test_the_written_kinematics_reach_where_the_arm_is(tmp_path: Path) -> None:
    world = station(41, links=False, size=2.0)
    fit = fit_kinematics(world.observations, world.q, arm_errors(ARM, "joints"), *_near(world))
    (tmp_path / "k.yaml").write_text(kinematics_text(fit, "refined"))
    refined = load_chain("ur10e", tmp_path / "k.yaml")
    zero = np.zeros((6, 6))
    real = flange_poses(ARM, world.new_q, world.errors)
    off = []
    for arm in (ARM, refined):
        # up to where the base stands and how the flange is turned, which no scan beside the arm shows
        off.append(_aligned(flange_poses(arm, world.new_q, zero)[:, :3, 3], real[:, :3, 3]))
    assert off[1] < 0.3 * off[0]
    with pytest.raises(InputError, match="Universal Robots arm"):
        load_chain("aubo_i5", tmp_path / "k.yaml")


def _near(world: WrongArmStation) -> tuple[RigidTransform, ScannerCorrection]:
    return estimate_eye_on_base(world.observations, SolveConfig(leave_one_out=False)).X_BC, ScannerCorrection()


def _aligned(a: Array, b: Array) -> float:
    """Mean distance after the best rigid motion (Kabsch)."""
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    R = RotationMatrix.ProjectToRotationMatrix(q.T @ p).matrix()
    return float(np.linalg.norm(p @ R.T - q, axis=1).mean())


def test_an_arm_without_errors_is_left_alone_and_another_s_kinematics_are_found_out() -> None:
    none = _choice(station(42, scans=14, size=0.0), "joints")
    assert not none.accepted
    assert "do not help" in none.sentence
    wrong = _choice(station(43, scans=14, links=False, size=20.0), "joints")
    assert wrong.accepted
    assert "those of another robot" in wrong.sentence


def test_poses_of_one_orientation_and_few_poses_are_refused() -> None:
    world = station(44)
    same = world.observations[0].X_BR.rotation()
    alike = [replace(o, X_BR=RigidTransform(same, o.p_BR)) for o in world.observations]
    estimate = estimate_eye_on_base(world.observations, SolveConfig(leave_one_out=False))
    with pytest.raises(InputError, match=r"orientation of the flange varies by 0\.0 degrees only"):
        choose_kinematics(alike, world.q, ARM, "joints", {}, estimate)
    with pytest.raises(TooFewPoses, match="need 12"):
        choose_kinematics(world.observations[:8], world.q[:8], ARM, "links", {}, estimate)
    with pytest.raises(InputError, match="choose one of joints, links"):
        choose_kinematics(world.observations, world.q, ARM, "wrists", {}, estimate)


def test_informative_poses_know_more_than_the_first_ones() -> None:
    world = station(45, scans=60, planned=False)
    X_BC, _ = _near(world)
    chosen = informative_poses(ARM, X_BC, world.q, 15)
    assert len(set(chosen.tolist())) == 15
    rounded = world.q * (1.0 + 1e-14 * np.random.default_rng(1).normal(size=world.q.shape))
    assert informative_poses(ARM, X_BC, rounded, 15).tolist() == chosen.tolist()  # another processor chooses the same
    spread = []
    for rows in (chosen, np.arange(15)):
        scans = [world.observations[i] for i in rows]
        fit = fit_kinematics(scans, world.q[rows], arm_errors(ARM, "links"), X_BC, ScannerCorrection())
        # at the same scatter
        at = KinematicsFit(
            X_BC=fit.X_BC,
            correction=fit.correction,
            u=fit.u,
            covariance=fit.covariance,
            sigma_position_m=1e-9,
            sigma_normal_rad=1e-3,
            redundancy=1.0,
            errors=fit.errors,
        )
        C = at.predicted(world.new, world.new_q) / fit.sigma_position_m**2
        spread.append(float(np.sqrt(np.trace(C, axis1=1, axis2=2)).mean()))
    assert spread[0] < 0.85 * spread[1]
