"""Refines the live calibration once its scans are enough: a local field or errors of the arm, by held-out errors."""

import dataclasses as dc
from functools import partial

import numpy as np

from weldcal.calibration.eye_on_base.joint_fit import solve_jointly
from weldcal.calibration.eye_on_base.observations import corrected_observation
from weldcal.calibration.refinement.refined import PLAIN, Plain, Refined, refine_arm, refine_locally
from weldcal.models.arms.chain import chain_of
from weldcal.models.arms.kinematics import ArmModel, with_link_transforms
from weldcal.models.errors import WeldcalError
from weldcal.systems.messages import CalibrationStatus, Refinement

TIME_S = 120.0  # for which the job waits, at rest, for the folds beside a robot


def refined_status(status: CalibrationStatus, kind: str, arm: ArmModel, correct_scanner: bool) -> CalibrationStatus:
    """The status with its estimate refined by ``kind`` of LIVE_KINDS, or as it was with the reason; ``arm`` is the one that observed.

    The choice is that of `weldcal calibrate --refine`; live scans have no hole patterns.
    """
    estimate = status.estimate
    if estimate is None or kind == PLAIN:
        return status
    corrected = tuple(corrected_observation(status.correction, o) for o in status.observations)
    solve = partial(solve_jointly, start=estimate.X_BC, correct_scanner=correct_scanner)
    plain = Plain(
        observations=status.observations,
        corrected=corrected,
        patterns={},
        estimate=estimate,
        correction=estimate.scanner,
        correct_scanner=correct_scanner,
        solve=solve,
    )
    try:
        if kind == "local":
            found = refine_locally(plain, seed=0)
        else:
            note = f"{arm.name}, refined by a live calibration (calibration.refine: {kind})"
            found = refine_arm(kind, plain, np.array(status.joints), chain_of(arm), note=note, seed=0)
        return dc.replace(status, estimate=found.estimate, refinement=_message(kind, found, arm))
    except WeldcalError as error:
        return dc.replace(status, refinement=Refinement(kind=kind, sentence=f"The calibration is not refined: {error}"))


def _message(kind: str, found: Refined, arm: ArmModel) -> Refinement:
    corrected = None
    if found.stack is not None:
        corrected = with_link_transforms(arm, found.stack, "", "The refined kinematics")
    return Refinement(
        kind=kind,
        sentence=found.sentence,
        accepted=found.accepted,
        arm=corrected,
        local_field=found.field,
        kinematics=found.kinematics,
        arm_errors=found.arm,
        document=found.document(kind),
    )
