"""Refines a plain calibration by a local field or by errors of the arm, and keeps the plain one where that does not help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.kinematics_choice import choose_kinematics, kinematics_text, with_kinematics
from weldcal.calibration.refinement.local_field import LocalField, PlainSolve, choose_local, with_field
from weldcal.calibration.refinement.stated_arm import arm_document
from weldcal.models.arms.chain import Chain
from weldcal.models.arrays import Array

REFINEMENTS = ("local", "joints", "links")
PLAIN = "none"
LIVE_KINDS = (PLAIN, *REFINEMENTS)
"""What a live calibration may be told."""
KINEMATICS_FILE = "kinematics.yaml"


@dataclass(frozen=True, eq=False, kw_only=True)
class Plain:
    """A plain calibration: observations as seen and as corrected, their hole patterns, the estimate, the accepted scanner correction (None:
    none), whether one may be estimated, and how the calibration is made from fewer poses (None: as `calibrate` does)."""

    observations: Sequence[Observation]
    corrected: tuple[Observation, ...]
    patterns: Mapping[str, HolePattern]
    estimate: CalibrationEstimate
    correction: ScannerCorrection | None
    correct_scanner: bool = True
    solve: PlainSolve | None = None

    @property
    def inliers(self) -> list[Observation]:
        """The observations, as seen, that the estimate uses."""
        return [o for o, keep in zip(self.observations, self.estimate.inliers, strict=True) if keep]


@dataclass(frozen=True, eq=False, kw_only=True)
class Refined:
    """What became of it: estimate and observations; the field, or the text of the kinematics file, the link transforms (n, 4, 4) in it, the
    scanner correction that goes with them and the document of the errors, where one was accepted; the sentence that says so or why not;
    ``numbers`` for the JSON object."""

    estimate: CalibrationEstimate
    observations: tuple[Observation, ...]
    sentence: str
    accepted: bool
    field: LocalField | None = None
    kinematics: str = ""
    stack: Array | None = None
    correction: ScannerCorrection | None = None
    arm: dict[str, Any] | None = None
    numbers: dict[str, Any] | None = None

    def document(self, kind: str) -> dict[str, Any]:
        """For the JSON object of `calibrate`."""
        return {"kind": kind, "accepted": self.accepted, "sentence": self.sentence, **(self.numbers or {})}


def refine_locally(plain: Plain, *, seed: int) -> Refined:
    """Refine by a field of what the calibration leaves. Raises TooFewPoses below ten inliers."""
    choice = choose_local(
        plain.inliers,
        plain.patterns,
        plain.estimate.X_BC,
        plain.correction or ScannerCorrection(),
        correct_scanner=plain.correct_scanner,
        seed=seed,
        plain_solve=plain.solve,
    )
    estimate, observations = with_field(plain.estimate, choice, plain.corrected)
    return Refined(
        estimate=estimate,
        observations=tuple(observations),
        sentence=choice.sentence,
        accepted=choice.accepted,
        field=choice.field if choice.accepted else None,
    )


def refine_arm(kind: str, plain: Plain, q: Array, arm: Chain, *, note: str, seed: int) -> Refined:
    """Refine by errors of the arm ("joints" or "links") that stands at joint angles q (n, joints) rad in the n observations.

    ``note`` is the first line of the kinematics file. Raises TooFewPoses and InputError as choose_kinematics does.
    """
    choice = choose_kinematics(
        plain.inliers,
        q[plain.estimate.inliers],
        arm,
        kind,
        plain.patterns,
        plain.estimate,
        correct_scanner=plain.correct_scanner,
        seed=seed,
        plain_solve=plain.solve,
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
            estimate=replace(plain.estimate, held_out=held_out),
            observations=plain.corrected,
            sentence=choice.sentence,
            accepted=False,
            numbers=numbers,
        )
    estimate, moved = with_kinematics(plain.estimate, choice, plain.observations, q)
    return Refined(
        estimate=estimate,
        observations=tuple(moved),
        sentence=choice.sentence,
        accepted=True,
        kinematics=kinematics_text(found, note),
        stack=found.corrected_stack(),
        correction=found.correction if plain.correct_scanner else None,
        arm=arm_document(found),
        numbers=numbers,
    )
