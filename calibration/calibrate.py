"""Calibrates a scanner beside the robot from flange observations, step by step.

For `weldcal calibrate` and the live job.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.results import matrix4
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import InconsistentPoses, ScannerMoved
from weldcal.calibration.eye_on_base.change_point import ChangePoint, find_change
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, corrected_observation
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, calibrate_from_few
from weldcal.calibration.eye_on_base.joint_fit import ScannerVerdict, estimate_jointly
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.tcp import TcpOffset, find_tcp
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

if TYPE_CHECKING:
    from weldcal.calibration.refinement.local_field import LocalField
    from weldcal.models.arms.kinematics import Chain

REFINEMENTS = ("local", "joints", "links")
PLAIN = "none"
LIVE_KINDS = (PLAIN, *REFINEMENTS)
"""What `calibration.refine` of a scenario may be."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Steps:
    """What `calibrate` does with n observations.

    ``patterns``: hole patterns by id. ``correct_scanner``: a correction is applied where the scans show one.
    ``axis_turn_rad``: known rotation of the hole pattern, for one to three scans. ``feature_m``: radius of the flange,
    and ``X_FR``: the feature on it (None: not known), which say how far a TCP that was set shifts the poses.
    ``coplanar``: flange centres in one plane are enough, as where normals were measured. ``refine``: "none", "local",
    or "joints" or "links" of ``arm`` at ``joints`` (n, joints) rad; ``note`` is the first line of its kinematics file.
    """

    patterns: Mapping[str, HolePattern] = field(default_factory=dict)
    correct_scanner: bool = True
    axis_turn_rad: float | None = None
    X_FR: RigidTransform | None = None
    feature_m: float = np.inf
    coplanar: bool = False
    refine: str = PLAIN
    arm: Chain | None = None
    joints: Array | None = None
    note: str = ""
    seed: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """The estimate and the n ``observations`` with all corrections applied.

    The verdict on the scanner (None: not asked, or too few scans), the refinement (None: not asked), and ``warnings``,
    such as of a TCP that seems to be set. ``X_rigid``: X_BC from the scans as they are.
    """

    estimate: CalibrationEstimate
    observations: tuple[Observation, ...]
    scanner: ScannerVerdict | None
    refined: Refined | None
    warnings: tuple[str, ...]
    X_rigid: RigidTransform

    @property
    def correction(self) -> ScannerCorrection | None:
        """The correction of the scanner that belongs to the estimate; None where the scanner is taken as it is."""
        if self.refined is not None and self.refined.correction is not None:
            return self.refined.correction
        return None if self.scanner is None else self.scanner.accepted

    def inliers(self, observations: Sequence[Observation]) -> list[Observation]:
        """Those of n observations that the estimate uses."""
        return [o for o, keep in zip(observations, self.estimate.inliers, strict=True) if keep]


def calibrate(
    observations: Sequence[Observation], steps: Steps | None = None, tell: Callable[[str], None] = lambda step: None
) -> Calibration:
    """X_BC from n >= 1 observations: estimate, scanner correction, and the refinement that is asked for.

    ``tell`` gets each step's name.

    Below four observations the usual errors of robot and scanner stand for what the scans cannot show
    (calibrate_from_few). Deterministic.

    Raises:
        TooFewPoses, RepeatedPoses, CoplanarPoses: the poses do not determine X_BC, or are too few for the refinement.
        InconsistentPoses: they contradict each other, as where a TCP longer than the flange's radius is set at the
            robot.
        ScannerMoved: the scanner or the base moved during the recording.
        InputError: the refinement cannot be made from such poses.
    """
    steps, observations = steps or Steps(), tuple(observations)
    warnings: tuple[str, ...] = ()
    tell("solving")
    if len(observations) < ENOUGH:
        estimate = calibrate_from_few(observations, steps.patterns, steps.axis_turn_rad, seed=steps.seed)
        scanner, X_rigid = None, estimate.X_BC
    else:
        estimate, scanner, X_rigid, warnings = _estimate_consistent(observations, steps)
    accepted = None if scanner is None else scanner.accepted
    corrected = observations if accepted is None else tuple(corrected_observation(accepted, o) for o in observations)
    plain = Calibration(
        estimate=estimate, observations=corrected, scanner=scanner, refined=None, warnings=warnings, X_rigid=X_rigid
    )
    if steps.refine == PLAIN:
        return plain
    tell("refining")
    return refine(plain, observations, steps)


def refine(plain: Calibration, observations: Sequence[Observation], steps: Steps) -> Calibration:
    """Return a calibration without a refinement, refined as ``steps`` say.

    ``observations`` (n) are those it was made from, as measured.

    It stays as it is, but for nested held-out errors, where that does not help. Raises TooFewPoses and InputError as
    `calibrate` does.
    """
    way = _refine_locally if steps.refine == "local" else _refine_arm
    refined = way(plain, observations, steps)
    return replace(plain, estimate=refined.estimate, observations=refined.observations, refined=refined)


def _estimate_consistent(
    observations: tuple[Observation, ...], steps: Steps
) -> tuple[CalibrationEstimate, ScannerVerdict | None, RigidTransform, tuple[str, ...]]:
    """Estimate X_BC and judge the scanner, with a sentence where the poses look as if a TCP were set.

    Returns the estimate, the verdict on the scanner, X_BC from the scans as they are, and the sentences.
    """
    config = SolveConfig(seed=steps.seed, allow_coplanar=steps.coplanar)
    change = find_change(observations)
    try:
        estimate, scanner = estimate_jointly(
            observations, steps.patterns, correct_scanner=steps.correct_scanner, config=config
        )
    except InconsistentPoses as refusal:
        tcp = find_tcp(observations)
        _refuse_change(change, tcp, observations)
        if tcp is None:
            raise
        raise InconsistentPoses(tcp.sentence(steps.X_FR)) from refusal
    rigid = estimate_eye_on_base(observations, replace(config, leave_one_out=False)).X_BC
    tcp = find_tcp(observations, rigid)
    _refuse_change(change, tcp, observations)
    if tcp is not None and tcp.surely_beyond(steps.feature_m):
        raise InconsistentPoses(tcp.sentence(steps.X_FR))
    return estimate, scanner, rigid, () if tcp is None else (tcp.sentence(steps.X_FR),)


def _refuse_change(change: ChangePoint | None, tcp: TcpOffset | None, observations: tuple[Observation, ...]) -> None:
    """Refuses a recording in which the scanner moved, and offers both of its parts.

    Raises:
        ScannerMoved: naming the two poses, the shift, and the option that takes either part.
    """
    if change is None or (tcp is not None and tcp.with_m < np.sqrt(3.0) * change.with_m):
        return
    parts: list[dict[str, object]] = []
    offers = []
    for part, option in (
        (observations[: change.index], f":{change.before}"),
        (observations[change.index :], f"{change.after}:"),
    ):
        parts.append({"poses": option, "n": len(part), **_part(part)})
        offers.append(f"--poses {option} ({len(part)} scans)")
    raise ScannerMoved(
        f"The scanner or the robot's base moved between '{change.before}' and '{change.after}'. The scans before and"
        f" after give two scanner poses, which differ by {1e3 * change.shift_m:.2f} mm at the flange and"
        f" {np.degrees(change.rotation_rad):.3f} degrees. Calibrate one part: {' or '.join(offers)}. Only the later"
        " part"
        " is valid for the scanner where it is now.",
        {
            "change_point": {
                "before": change.before,
                "after": change.after,
                "shift_mm": 1e3 * change.shift_m,
                "rotation_deg": float(np.degrees(change.rotation_rad)),
                "probability_by_chance": change.probability,
                "parts": parts,
            }
        },
    )


def _part(observations: tuple[Observation, ...]) -> dict[str, object]:
    """X_BC from one part of a recording and its held-out error (mm, median); None where it fixes no calibration."""
    try:
        found = estimate_eye_on_base(observations, SolveConfig(allow_coplanar=True))
    except InputError:
        return {"X_BC": None, "held_out_median_mm": None}
    errors = found.held_out.position_m[found.inliers]
    errors = errors[np.isfinite(errors)]
    median = 1e3 * float(np.median(errors)) if len(errors) else None
    return {"X_BC": matrix4(found.X_BC), "held_out_median_mm": median}


@dataclass(frozen=True, eq=False, kw_only=True)
class Refined:
    """What became of it: estimate and observations.

    The field, or the text of the kinematics file, the link transforms (n, 4, 4) in it, the scanner correction that goes
    with them and the document of the errors, where one was accepted; the sentence that says so or why not; ``numbers``
    for the JSON object.
    """

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


def _refine_locally(plain: Calibration, observations: Sequence[Observation], steps: Steps) -> Refined:
    """Refine by a field of what the calibration leaves. Raises TooFewPoses below ten inliers."""
    from weldcal.calibration.refinement.local_field import choose_local, with_field

    choice = choose_local(
        plain.inliers(observations),
        steps.patterns,
        plain.estimate.X_BC,
        plain.correction or ScannerCorrection(),
        correct_scanner=steps.correct_scanner,
        seed=steps.seed,
    )
    estimate, moved = with_field(plain.estimate, choice, plain.observations)
    return Refined(
        estimate=estimate,
        observations=tuple(moved),
        sentence=choice.sentence,
        accepted=choice.accepted,
        field=choice.field if choice.accepted else None,
    )


def _refine_arm(plain: Calibration, observations: Sequence[Observation], steps: Steps) -> Refined:
    """Refine by errors of the arm. Raises TooFewPoses and InputError as choose_kinematics does."""
    from weldcal.calibration.refinement.kinematics_choice import (
        arm_document,
        choose_kinematics,
        kinematics_text,
        with_kinematics,
    )

    if steps.arm is None or steps.joints is None:
        raise InputError(f"Errors of the arm (refine: {steps.refine}) need the arm and its joint angles at each scan.")
    q = steps.joints
    choice = choose_kinematics(
        plain.inliers(observations),
        q[plain.estimate.inliers],
        steps.arm,
        steps.refine,
        steps.patterns,
        plain.estimate,
        correct_scanner=steps.correct_scanner,
        seed=steps.seed,
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
            observations=plain.observations,
            sentence=choice.sentence,
            accepted=False,
            numbers=numbers,
        )
    estimate, moved = with_kinematics(plain.estimate, choice, observations, q)
    return Refined(
        estimate=estimate,
        observations=tuple(moved),
        sentence=choice.sentence,
        accepted=True,
        kinematics=kinematics_text(found, steps.note),
        stack=found.corrected_stack(),
        correction=found.correction if steps.correct_scanner else None,
        arm=arm_document(found),
        numbers=numbers,
    )
