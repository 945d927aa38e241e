"""A live calibration is refined once its scans are enough, and the corrected arm is the one that the cell believes from
then on."""

from __future__ import annotations

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.cells import EXACT_PLATE, SMALL_IDEAL_SCANNER, scenario
from tests.worlds.wrong_models import WrongArmStation, station
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.hand_eye.joints import flange_poses
from weldcal.calibration.refinement.kinematics_choice import kinematics_text
from weldcal.calibration.refinement.kinematics_fit import KinematicsFit, arm_errors
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.iterative_calibrator import refined_status
from weldcal.systems.messages import CalibrationStatus
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.parts import corrected_arm
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import make_station


def status_of(world: WrongArmStation) -> CalibrationStatus:
    """The live calibration of a light world, before it is refined."""
    seen = tuple(world.observations)
    return CalibrationStatus(observations=seen, joints=tuple(world.q), estimate=estimate_jointly(seen)[0], done=True)


def flange(arm: ArmModel, q: Array) -> Array:
    return np.array([forward_kinematics(arm, each).translation() for each in q])


def new_errors(status: CalibrationStatus, world: WrongArmStation) -> Array:
    """Errors at new scans, m, where the arm that the cell believes says that it is."""
    arm, X_BC = status.arm_or(load_arm("ur10e")), status.X_BC
    assert X_BC is not None
    seen = [
        dc.replace(corrected_observation(status.correction, o), X_BR=forward_kinematics(arm, q))
        for o, q in zip(world.new, world.new_q, strict=True)
    ]
    return position_errors(X_BC, seen)


def test_the_arm_s_errors_are_found_and_its_new_poses_agree_with_new_scans() -> None:
    """Over three worlds: what one world gains depends on which errors its arm happens to have."""
    floor = 3.0 * (2e-5**2 + 2e-5**2)  # of the world's repeatability and fits, which no calibration takes away
    left = np.zeros(2)
    for seed in (7, 8, 9):
        world = station(seed, scans=16, links=False)
        before = status_of(world)
        after = refined_status(before, "joints", load_arm("ur10e"), True)
        assert after.refinement is not None
        assert after.refinement.accepted, after.refinement.sentence
        assert after.refinement.document["kind"] == "joints"
        left += [np.mean(new_errors(status, world) ** 2) - floor for status in (before, after)]
    plain, refined = left
    assert refined < 0.5 * plain
    assert refined_status(before, "none", load_arm("ur10e"), True) is before


def test_a_wrong_factory_file_is_found_out_and_what_cannot_be_refined_stays_plain(tmp_path: Path) -> None:
    """The controller computes with another robot's file; the sentence says so, and the file written for it is the
    cell's afterwards."""
    world = station(43, scans=14, links=False, size=20.0)
    arm = load_arm("ur10e")
    found = refined_status(status_of(world), "joints", arm, True).refinement
    assert found is not None
    assert found.arm is not None
    assert "those of another robot" in found.sentence
    (tmp_path / "kinematics.yaml").write_text(found.kinematics)
    told = scenario(f"corrected_kinematics: {tmp_path}/kinematics.yaml")
    believed = corrected_arm(told, arm)
    np.testing.assert_allclose(flange(believed, world.new_q), flange(found.arm, world.new_q), atol=1e-9)
    off = [_turned_away(arm, world), _turned_away(believed, world)]
    assert off[1] < 0.1 * off[0]
    few = status_of(station(43, scans=8))
    kept = refined_status(few, "links", arm, True)
    assert kept.estimate is few.estimate
    assert kept.refinement is not None
    assert "need 12 usable poses, and there are 8" in kept.refinement.sentence


def _turned_away(arm: ArmModel, world: WrongArmStation) -> float:
    """Mean distance (m) of the flange's travel between new poses from the true arm's: the first joint's zero, which no
    scan shows, drops out of lengths."""
    true = flange_poses(load_chain("ur10e"), world.new_q, world.errors)[:, :3, 3]
    p = flange(arm, world.new_q)
    lengths = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (p, true)]
    return float(np.abs(lengths[0] - lengths[1]).mean())


def test_a_station_believes_the_corrected_kinematics_and_its_world_does_not(tmp_path: Path) -> None:
    arm = load_arm("ur10e")
    found = _offset_file(tmp_path / "elbow.yaml", np.radians(0.1))
    q = np.radians([10.0, -80.0, 100.0, -110.0, -90.0, 20.0])
    built = make_station(scenario(f"corrected_kinematics: {found}", SMALL_IDEAL_SCANNER, EXACT_PLATE), 0)
    try:
        believed, true = forward_kinematics(built.arm, q), built.truth.arm
        assert true is not None
        moved = np.linalg.norm(believed.translation() - forward_kinematics(arm, q).translation())
        assert 5e-4 < moved < 2e-3
        np.testing.assert_allclose(true.stack, arm.stack)
    finally:
        built.close()
    other = scenario(f"corrected_kinematics: {_offset_file(tmp_path / 'other.yaml', np.radians(5.0))}")
    with pytest.raises(InputError, match=r"moves the flange by .* mm from a nominal ur10e"):
        corrected_arm(other, arm)


def _offset_file(path: Path, offset_rad: float) -> Path:

    nothing = arm_errors(load_chain("ur10e"), "joints")
    u = np.zeros(len(nothing.which))
    u[nothing.names.index("elbow_joint offset")] = offset_rad / nothing.scale[0]
    fit = KinematicsFit(
        X_BC=RigidTransform(),
        correction=ScannerCorrection(),
        u=u,
        covariance=np.eye(1),
        sigma_position_m=1.0,
        sigma_normal_rad=1.0,
        redundancy=1.0,
        errors=nothing,
    )
    path.write_text(kinematics_text(fit, "an elbow's zero"))
    return path


@pytest.mark.parametrize(
    ("kind", "scans", "said"),
    [
        ("joints", 11, "needs 12 scans and more"),
        ("local", 9, "needs 10 scans and more"),
        ("magic", 20, "none, local, joints or links"),
    ],
)
def test_too_few_scans_and_an_unknown_refinement_are_named_before_any_work(kind: str, scans: int, said: str) -> None:
    asked: Scenario = scenario()
    asked.calibration.refine, asked.calibration.minimum_scans, asked.calibration.maximum_scans = kind, scans, 30
    with pytest.raises(InputError, match=said):
        check_scenario(asked)
