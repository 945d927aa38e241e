"""The refinements of `weldcal calibrate --refine`: chooses by nested held-out errors and says what was chosen."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.eye_on_base.self_calibration import SelfCalibration
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.joint_angles import require_joint_angles
from weldcal.calibration.refinement.kinematics_choice import choose_kinematics, kinematics_text, with_kinematics
from weldcal.calibration.refinement.local_choice import choose_local, with_field
from weldcal.calibration.refinement.local_field import LocalField
from weldcal.calibration.refinement.stated_arm import arm_document
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import known_arms
from weldcal.models.errors import InputError

REFINEMENTS = ("local", "joints", "links")
KINEMATICS_FILE = "kinematics.yaml"


@dataclass(frozen=True, eq=False)
class Refinable:
    """A plain calibration: its data, observations as seen and as corrected, their hole patterns, the estimate, the verdict on the scanner
    and the name of the robot, with the file of its kinematics where it has one."""

    data: Dataset
    observations: list[Observation]
    patterns: dict[str, HolePattern]
    estimate: CalibrationEstimate
    corrected: tuple[Observation, ...]
    scanner: SelfCalibration | None
    robot: str
    kinematics: Path | None = None

    @property
    def inliers(self) -> list[Observation]:
        """The observations, as seen, that the estimate uses."""
        return [o for o, keep in zip(self.observations, self.estimate.inliers, strict=True) if keep]


@dataclass(frozen=True, eq=False)
class Refined:
    """What became of it: estimate and observations; the field, or the text of the kinematics file and the scanner correction that goes with
    it and the document of the errors, where one was accepted; the sentence that says so or why not; ``numbers`` for the JSON object."""

    estimate: CalibrationEstimate
    observations: tuple[Observation, ...]
    sentence: str
    accepted: bool
    field: LocalField | None = None
    kinematics: str = ""
    correction: ScannerCorrection | None = None
    arm: dict[str, Any] | None = None
    numbers: dict[str, Any] | None = None

    def document(self, kind: str) -> dict[str, Any]:
        """For the JSON object of `calibrate`."""
        return {"kind": kind, "accepted": self.accepted, "sentence": self.sentence, **(self.numbers or {})}


def refine_calibration(kind: str, plain: Refinable, *, correct_scanner: bool, seed: int) -> Refined:
    """Refine a calibration by ``kind`` of REFINEMENTS; it stays as it is, but for nested held-out errors, where that does not help.

    Raises TooFewPoses and other InputErrors where the data cannot be refined in this way.
    """
    if kind != "local":
        return _arm(kind, plain, correct_scanner, seed)
    accepted = None if plain.scanner is None else plain.scanner.accepted
    correction = accepted or ScannerCorrection()
    choice = choose_local(
        plain.inliers, plain.patterns, plain.estimate.X_BC, correction, correct_scanner=correct_scanner, seed=seed
    )
    estimate, observations = with_field(plain.estimate, choice, plain.corrected)
    return Refined(
        estimate, tuple(observations), choice.sentence, choice.accepted, choice.field if choice.accepted else None
    )


def _arm(kind: str, plain: Refinable, correct_scanner: bool, seed: int) -> Refined:
    if plain.robot not in known_arms():
        raise InputError(
            f"Errors of the arm (--refine {kind}) are written as Universal Robots' kinematics: name one of {', '.join(known_arms())} with "
            "--robot, or use --refine local."
        )
    arm = load_chain(plain.robot, plain.kinematics)
    ids = [o.id for o in plain.observations]
    given = {p.id: p.X_BR for p in plain.data.pairs} or plain.data.poses
    stated = np.array([given[id].GetAsMatrix4() for id in ids])
    q = require_joint_angles(plain.data, ids, arm, stated)
    choice = choose_kinematics(
        plain.inliers,
        q[plain.estimate.inliers],
        arm,
        kind,
        plain.patterns,
        plain.estimate,
        correct_scanner=correct_scanner,
        seed=seed,
    )
    found = choice.fit
    numbers = {
        "errors": [
            {"name": name, "value": float(v), "sigma": float(s)}
            for name, v, s in zip(found.errors.names, found.values, found.sigma, strict=True)
        ]
    }
    if not choice.accepted:
        held_out = replace(plain.estimate.held_out, position_m=plain.estimate.held_out.position_m.copy())
        held_out.position_m[plain.estimate.inliers] = choice.plain_m
        return Refined(
            replace(plain.estimate, held_out=held_out), plain.corrected, choice.sentence, False, numbers=numbers
        )
    estimate, moved = with_kinematics(plain.estimate, choice, plain.observations, q)
    text = kinematics_text(found, f"{plain.robot}, refined by weldcal calibrate --refine {kind}")
    return Refined(
        estimate,
        tuple(moved),
        choice.sentence,
        True,
        kinematics=text,
        correction=found.correction if correct_scanner else None,
        arm=arm_document(found),
        numbers=numbers,
    )
