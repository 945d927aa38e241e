"""Verify a calibration on recorded scans of the flange that it did not use: the error of each, and what it shows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.dataset import Dataset, joint_angles, load_dataset
from weldcal.calibration.data.results import RESULT_FILE, CalibrationResult, load_result, software_version
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE, read_stated_pose
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges
from weldcal.calibration.eye_on_base.stated_error import (
    FALSE_ALARM,
    joint_terms,
    place_sensitivity,
    scatter_elsewhere,
    stated_median_limit,
)
from weldcal.calibration.eye_on_base.validation import Offset, offset_from, position_errors, scale_error, tilt_errors
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import as_transform, skew
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_choice import shared_error
from weldcal.calibration.refinement.local_field import field_from_document
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange

FEW = 4
"""Scans below which a verification says little."""
WORST_TILT_DEG = 10.0  # a wrong convention of poses, no error of a calibration
_TURN_DEG = 3.0  # orientations closer than this are one orientation to a verification
_GROSS = 10.0  # times the usual error: a gross outlier
_SAME_MM = 1e-6  # a scan of the same name whose error repeats the recorded residual to a nanometre is the same scan
_EVIDENT = 4.0  # standard errors of a scale error that is worth naming
_BEYOND_CHANCE = 0.99  # one sound calibration in a hundred is off by more than this quantile of what is known
_UNCORRECTED = (
    "The result's scanner correction is not applied, as requested. Its X_BC belongs to corrected points, so these are"
    " the errors of a program that does not correct its scans."
)


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """What is asked of a verification.

    Attributes:
        flange, robot: in place of those of dataset.yaml and the result.
        correct_scanner: apply the result's scanner correction.
        limit_mm: of the new scans' median; None: it follows from what the calibration states.
        pose: names the pose in a file of several.
        correct: shift the calibration by what the new scans show, where that is more than chance.
    """

    flange: str | None = None
    robot: str | None = None
    correct_scanner: bool = True
    limit_mm: float | None = None
    pose: str | None = None
    correct: bool = False
    seed: int = 0


@dataclass(frozen=True)
class PoseError:
    """One scan: distance (mm) of the flange centres by calibration and robot, and angle (deg) of the normals.

    The angle is None where no normal was seen; also whether the calibration used this scan.
    """

    id: str
    error_mm: float
    tilt_deg: float | None
    used_before: bool


@dataclass(frozen=True, kw_only=True)
class VerifiedScans:
    """A calibration judged on scans.

    Attributes:
        observations: with the scanner correction, where the result has one.
        limit_mm, source: limit of the median of new scans and where it is from; None: the calibration states no error.
        concerns: sentences that leave the verdict at "use with care"; ``other_arm`` says that the arm has another name.
        flange: what an option must state for these scans.
        notes: how the files were read.
        offset: how far X_BC is off by the new scans alone; None where they are too few.
        corrected, shift: the calibration shifted by that, and a sentence on it, where this was asked for.
    """

    result: CalibrationResult
    correction: ScannerCorrection | None
    observations: tuple[Observation, ...]
    fits: dict[str, FlangeFit]
    poses: tuple[PoseError, ...]
    refused: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    hashes: dict[str, str]
    limit_mm: float | None = None
    source: str = ""
    concerns: tuple[str, ...] = ()
    other_arm: str = ""
    notes: tuple[str, ...] = ()
    offset: Offset | None = None
    flange: str = ""
    corrected: CalibrationResult | None = None
    shift: str = ""


def verify_scans(
    result: Path,
    dataset: Path,
    asked: VerifyOptions | None = None,
    tell: Callable[[str, float], None] = lambda step, fraction: None,
) -> VerifiedScans:
    """Verify a calibration on a dataset folder.

    The calibration is its folder or calibration.yaml, or any file with a pose. Errors are taken at the flange centre,
    in the base, after the result's scanner correction. A scan in which no flange is found is named and not used.

    Raises:
        InputError: the result or the dataset cannot be used.
    """
    asked = asked or VerifyOptions()
    calibrations, read_as = _calibrations(result, asked.pose)
    data, standard, seen = _find_flanges(calibrations, dataset, asked, tell)
    differences = _differences(calibrations[0], data, standard.designation)
    other_arm = differences[0] if differences and data.header.robot not in ("", calibrations[0].robot) else ""
    if not seen.observations:
        first, reason = seen.refused[0]
        none = f"None of the {len(seen.refused)} scans can be used. Reason for the first, {first}: {reason}"
        raise InputError(f"{other_arm} {none}".lstrip())
    calibration = min(calibrations, key=lambda one: float(np.median(position_errors(one.X_BC, seen.observations))))
    judged = _corrected(result, calibration, data, seen.observations, asked.correct_scanner)
    observations = judged.observations
    poses = _judge(calibration, data, observations)
    new = [k for k, p in enumerate(poses) if not p.used_before]
    limit_mm, source = asked.limit_mm, "as given with --limit-mm"
    if limit_mm is None:
        limit_mm = _stated_limit(calibration, judged, new)
        source = f"which {100 * FALSE_ALARM:.0f} % of verifications of a calibration as good as it states exceed"
    without, evident = _uncorrected(calibration, observations)
    fresh = [observations[k] for k in new]
    offset = offset_from(calibration.X_BC, fresh, asked.seed)
    shifted: tuple[CalibrationResult | None, str] = (None, "")
    if asked.correct:
        shifted = shifted_result(calibration, judged.correction, fresh, offset)
    return VerifiedScans(
        result=calibration,
        correction=judged.correction,
        observations=observations,
        fits=seen.fits,
        poses=poses,
        refused=seen.refused,
        warnings=(
            *differences,
            *judged.sentences,
            *(f"{id} was not used: {reason}" for id, reason in seen.refused),
            *_diagnostics(calibration, data, observations, poses),
            *(without if evident else ()),
        ),
        hashes=data.hashes,
        limit_mm=limit_mm,
        source=source,
        concerns=(*differences, *_gross(calibration, poses), *judged.sentences, *_alike(data, observations)),
        other_arm=other_arm,
        notes=read_as if evident else (*read_as, *without),
        offset=offset,
        flange=standard.designation if asked.flange or not data.header.flange else "",
        corrected=None if shifted[0] is None else replace(shifted[0], data_hashes=data.hashes),
        shift=shifted[1],
    )


def shifted_result(
    result: CalibrationResult,
    correction: ScannerCorrection | None,
    observations: Sequence[Observation],
    offset: Offset | None,
) -> tuple[CalibrationResult | None, str]:
    """Shift a calibration by its offset on new observations (n), and say so; None where chance explains the offset.

    Eq. (21) of the flange paper for the position, from all new scans in place of one registration. In the middle of
    these scans the shifted pose is as good as they are; its rotation stays. Its held-out errors are theirs, each with
    the shift from the others.
    """
    if offset is None:
        return None, "Not corrected: the new scans do not determine a pose. Take four or more across the work space."
    p_CQ = np.asarray(offset.new.X_BC.inverse() @ offset.p_BQ)
    whole, terms = joint_terms(result, correction)
    J = place_sensitivity(result, p_CQ, terms)
    of_both = J @ whole @ J.T + offset.covariance
    n = int(offset.new.inliers.sum())
    limit = 3.0 * f_quantile(_BEYOND_CHANCE, 3, max(3.0 * n - 6.0, 3.0))
    off = 1e3 * float(np.linalg.norm(offset.shift_m))
    if float(offset.shift_m @ np.linalg.solve(of_both, offset.shift_m)) <= limit:
        return None, f"Not corrected: an offset of {off:.3f} mm is chance here, and a shift would make it worse."
    turn_sigma = float(np.sqrt(np.linalg.eigvalsh(result.covariance[:3, :3] + offset.new.covariance[:3, :3])[-1]))
    if offset.turn_rad > _EVIDENT * turn_sigma:
        return None, (
            f"Not corrected: X_BC is also turned by {np.degrees(offset.turn_rad):.2f} degrees, which a shift leaves."
            " Calibrate from these scans."
        )
    X = RigidTransform(result.X_BC.rotation(), result.X_BC.translation() - offset.shift_m)
    lever = np.eye(6)
    lever[3:, :3] = skew(offset.p_BQ - X.translation())  # the turn is about the point that is known
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = result.covariance[:3, :3], offset.covariance
    joint = result.joint_covariance
    if joint is not None:
        joint = joint.copy()
        joint[:6, 6:] = joint[6:, :6] = 0.0
        joint[:6, :6] = lever @ covariance @ lever.T
    kept = [o for o, keep in zip(observations, offset.new.inliers, strict=True) if keep]
    held = 1e3 * position_errors(X, kept) * n / max(n - 1, 1)
    sentence = (
        f"X_BC is shifted by {off:.3f} mm, which {n} new scans show. At their middle it is known to"
        f" {1e3 * offset.sigma_m:.3f} mm (one sigma)."
    )
    shifted = replace(
        result,
        X_BC=X,
        covariance=lever @ covariance @ lever.T,
        joint_covariance=joint,
        held_out_mm={
            "median": float(np.median(held)),
            "mean": float(held.mean()),
            "p95": float(np.percentile(held, 95.0)),
        },
        warnings=(*result.warnings, sentence),
        software=software_version(),
    )
    return shifted, sentence


def _find_flanges(
    calibrations: list[CalibrationResult], dataset: Path, asked: VerifyOptions, tell: Callable[[str, float], None]
) -> tuple[Dataset, FlangeStandard, FlangeObservations]:
    """Read the dataset, and find the flange in each scan where the calibration says that it is."""
    stated = calibrations[0]
    data = load_dataset(dataset, robot=asked.robot or stated.robot)
    standard = get_flange(asked.flange or data.header.flange or stated.flange)
    seen = fit_flanges(
        data,
        standard,
        X_BC=stated.X_BC if len(calibrations) == 1 else None,
        holes=False,
        seed=asked.seed,
        tell=lambda fraction: tell("fitting flanges", 0.9 * fraction),
    )
    return seen.data or data, standard, seen


@dataclass(frozen=True)
class _Corrected:
    """Observations as the result corrects them; what it states of their errors elsewhere, and of the arm's."""

    observations: tuple[Observation, ...]
    correction: ScannerCorrection | None
    scatter: Array | None
    shared: tuple[Array, Array] | None
    sentences: tuple[str, ...]


def _corrected(
    file: Path, result: CalibrationResult, data: Dataset, seen: tuple[Observation, ...], correct_scanner: bool
) -> _Corrected:
    """Apply the result's kinematics, scanner correction and local field."""
    correction = correction_from_document(result.scanner_correction) if correct_scanner else None
    sentences = () if correct_scanner or result.scanner_correction is None else (_UNCORRECTED,)
    arm_used, moved, shared = _with_kinematics(file, result, data, seen, correction)
    observations = tuple(o if correction is None else corrected_observation(correction, o) for o in moved)
    local = field_from_document(result.local_field) if correct_scanner else None
    scatter = scatter_elsewhere(result, observations) if shared is None else None
    if local is not None:
        scatter = local.at([o.X_BR for o in observations])[1]
        observations = tuple(local.applied(result.X_BC, observations))
    return _Corrected(observations, correction, scatter, shared, (*sentences, *arm_used))


def _stated_limit(result: CalibrationResult, judged: _Corrected, new: list[int]) -> float | None:
    """Return the limit (mm) for the median of the new scans that follows from what the calibration states."""
    spread = None if judged.scatter is None else judged.scatter[new]
    shared = None if judged.shared is None else (judged.shared[0][new], judged.shared[1])
    observations = [judged.observations[k] for k in new]
    return stated_median_limit(result, observations, judged.correction, spread, shared)


def _calibrations(path: Path, pose: str | None) -> tuple[list[CalibrationResult], tuple[str, ...]]:
    """Read what `calibrate` wrote, or a camera's pose in every reading that its numbers allow, with a sentence."""
    try:
        return [load_result(path)], ()
    except InputError:
        if not path.exists() or (
            (path / RESULT_FILE if path.is_dir() else path).name == RESULT_FILE and not (path / HAND_EYE_FILE).is_file()
        ):
            raise
    given = read_stated_pose(path, pose)
    if given.mounting not in (None, "eye_on_base"):
        raise InputError(
            f"'{given.name}' is the pose of a camera on the flange, which does not scan its own flange: give pairs of"
            " poses or pictures (--board) in place of scans."
        )
    covariance = np.zeros((6, 6)) if given.covariance is None else given.covariance
    found = [
        CalibrationResult(X_BC=as_transform(one.X), covariance=covariance, held_out_mm={}, tilt_deg={}, poses=())
        for one in given.readings
    ]
    best = f", the reading of {len(found)} that fits these scans best" if len(found) > 1 else ""
    return found, (f"RESULT is {given.form} in {given.unit}{best}. It states no errors of scans.",)


def _with_kinematics(
    file: Path,
    result: CalibrationResult,
    data: Dataset,
    observations: tuple[Observation, ...],
    correction: ScannerCorrection | None,
) -> tuple[tuple[str, ...], tuple[Observation, ...], tuple[Array, Array] | None]:
    """Move the observations to the poses that the arm of the result's kinematics file reaches.

    With what it states of their errors (see shared_error), or a sentence where the scans have no joint angles.
    """
    if not result.kinematics_file:
        return (), observations, None
    q = joint_angles(data, [o.id for o in observations], 6)
    if q is None:
        return (
            (
                (
                    f"The result belongs to the arm of {result.kinematics_file}, and these scans have no joint angles"
                    " (q1 to q6): the stated poses are used."
                ),
            ),
            observations,
            None,
        )
    folder = file if file.is_dir() else file.parent
    arm = load_arm(result.robot, folder / result.kinematics_file)
    X_FR = RigidTransform() if data.pairs else data.X_FR
    poses = (forward_kinematics(arm, each) @ X_FR for each in q)
    moved = tuple(replace(o, X_BR=X) for o, X in zip(observations, poses, strict=True))
    if correction is None and result.scanner_correction is not None:
        return (), moved, None  # what is stated is that of corrected scans
    return (), moved, shared_error(result, folder / result.kinematics_file, correction, moved, q)


def _judge(result: CalibrationResult, data: Dataset, observations: tuple[Observation, ...]) -> tuple[PoseError, ...]:
    errors = 1e3 * position_errors(result.X_BC, observations)
    tilts = np.degrees(tilt_errors(result.X_BC, observations))
    known = {digest for name, digest in result.data_hashes.items() if name.startswith("clouds/")}
    same_pairs = bool(data.pairs) and result.data_hashes.get("pairs.csv") == data.hashes["pairs.csv"]
    records = {p.id: p.residual_mm for p in result.poses if p.residual_mm is not None}
    poses = []
    for o, e, t in zip(observations, errors, tilts, strict=True):
        recorded = records.get(o.id)
        again = recorded is not None and abs(recorded - float(e)) < _SAME_MM
        if not data.pairs:
            again = again or data.hashes[f"clouds/{data.clouds[o.id].name}"] in known
        poses.append(PoseError(o.id, float(e), float(t) if np.isfinite(t) else None, again or same_pairs))
    return tuple(poses)


def _alike(data: Dataset, observations: tuple[Observation, ...]) -> list[str]:
    """Return a sentence where these scans cannot show an error that is constant in the flange's frame."""
    if data.pairs and not all(p.has_orientation for p in data.pairs):
        return ["The pairs have no orientations of the flange. Whether the orientation varies is not known."]
    turned = [o.X_BR for o in observations]
    if len(turned) > 1 and turn_deg(turned) < _TURN_DEG:
        return [
            f"The orientations hardly vary (by {turn_deg(turned):.1f} degrees). A constant error of the flange centre "
            "would not show in these figures."
        ]
    return []


def _gross(result: CalibrationResult, poses: tuple[PoseError, ...]) -> list[str]:
    """Return a sentence on scans far off all others."""
    n, median = len(poses), float(np.median([p.error_mm for p in poses]))
    gross = [p for p in poses if p.error_mm > _GROSS * max(median, result.held_out_mm.get("p95") or 0.0)]
    if not gross:
        return []
    names = ", ".join(f"{p.id} by {p.error_mm:.1f} mm" for p in gross[:8]) + (" ..." if len(gross) > 8 else "")
    are = "is a gross outlier" if len(gross) == 1 else "are gross outliers"
    return [f"{len(gross)} of the {n} scans {are}: {names}."]


def _differences(result: CalibrationResult, data: Dataset, flange: str) -> list[str]:
    """Names that differ between the calibration and these scans."""
    h = data.header
    pairs = (
        ("robot", result.robot, h.robot),
        ("flange", result.flange, flange),
        ("scanner", result.scanner, h.scanner),
    )
    return [
        f"The calibration was made with the {what} '{was}', these scans with '{now}'. The figures are valid only if"
        " both names mean the same one."
        for what, was, now in pairs
        if was and now and was != now
    ]


def _diagnostics(
    result: CalibrationResult, data: Dataset, observations: tuple[Observation, ...], poses: tuple[PoseError, ...]
) -> list[str]:
    """Warnings about the figures: what makes them too small, and what they indicate about the cell."""
    out = []
    again = [p.id for p in poses if p.used_before]
    n = len(poses)
    if again:
        names = ", ".join(again[:5]) + (f" and {len(again) - 5} more" if len(again) > 5 else "")
        out.append(
            f"{len(again)} of the {n} scans were used in the calibration ({names}), so their errors are too small. Take"
            " new scans."
        )
    if n < FEW:
        out.append(f"Only {n} scan{' was' if n == 1 else 's were'} used. Take {FEW} or more across the work space.")
    out += _alike(data, observations)
    stated = result.held_out_mm.get("p95")
    median = float(np.median([p.error_mm for p in poses]))
    if stated is not None and median > (stated if n >= FEW else _GROSS * stated):
        out.append(
            f"The median error, {median:.2f} mm, is larger than the calibration's own held-out error at 95 %"
            f" ({stated:.2f} mm). Scanner, robot or flange has changed, or these scans are in another region: calibrate"
            " again."
        )
    out += _gross(result, poses)
    tilts = [p.tilt_deg for p in poses if p.tilt_deg is not None]
    if tilts and float(np.median(tilts)) > WORST_TILT_DEG:
        out.append(
            f"The scanned faces are turned by {np.median(tilts):.0f} degrees from the flange's z axis in the poses."
            " Check the quaternion order (qw, qx, qy, qz), that the poses are the flange's, and the calibration."
        )
    return out


def _uncorrected(result: CalibrationResult, observations: tuple[Observation, ...]) -> tuple[tuple[str, ...], bool]:
    """Return a sentence on an absent scanner correction (none: there is one), and whether these scans show its lack."""
    if result.scanner_correction is not None:
        return (), False
    text = "The result holds no scanner correction, so these errors include the scale error of the scanner"
    scale, sigma = scale_error(result.X_BC, observations)
    if np.isfinite(sigma) and abs(scale) > _EVIDENT * sigma:
        return (f"{text}: these scans show {1e2 * scale:+.2f} % (one sigma {1e2 * sigma:.2f} %).",), True
    return (f"{text}, if there is one.",), False
