"""weldcal profiler compensate: the sphere paper's method, with compensation by touches."""

from typing import Annotated, Any

import numpy as np

from weldcal.calibration.profiler.motion import Floats, rotation_groups
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere import linear as published
from weldcal.calibration.profiler.sphere.arc import fit_circle
from weldcal.calibration.profiler.sphere.joint import check_radius
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.errors import InputError
from weldcal.tools import console
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, switch
from weldcal.tools.commands.profiler.files import Measurements, PosesStated
from weldcal.tools.commands.profiler.result import (
    FileArgument,
    FormOption,
    PitchOption,
    PosesOption,
    RadiusOption,
    SetOption,
    TipOption,
    TouchesOption,
    TrialOption,
    UnitOption,
    check_number,
    outcome_of,
    with_warnings,
)
from weldcal.tools.commands.profiler.sphere import finish_sphere, read_sphere
from weldcal.tools.report.first_screen import check_limit


@command("profiler compensate", short_help="Calibrate by the published sphere method.")
def compensate(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    poses: PosesOption = None,
    robot_form: FormOption = "",
    pitch: PitchOption = None,
    radius: RadiusOption = None,
    touches: TouchesOption = None,
    tip: TipOption = "",
    solve_tip: Annotated[
        bool, switch("--solve-tip", "Also estimate the tip from the touches (not in the paper).")
    ] = False,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate by the sphere paper's two linear steps and its compensation. 'sphere' is more accurate on the same
    file."""
    check_limit(limit_mm)
    stated = PosesStated(poses, robot_form, pitch)
    data, measured = read_sphere(call, file, unit, dataset, trial, radius, touches, tip, stated=stated)
    record, found = calibrate_compensate(data, measured, solve_tip=solve_tip)
    if found["wrong_sides"]:
        console.emit_warning(
            f"The side of the sphere's centre is likely wrong in scans {found['wrong_sides']}. Check their sign."
        )
    folder = call.folder("profiler", file.stem)
    made, summary = finish_sphere(
        measured, SphereSigmas(), record, with_warnings(data, found), file.name, folder, limit_mm
    )
    return outcome_of(call, summary, made)


def calibrate_compensate(
    file: Measurements, data: SphereData, *, solve_tip: bool = False
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """The sphere paper's method: centres on the sides given in the file, two linear steps, compensation by touches."""
    sign = file.needed(
        "sign", "on which side (+1 or -1, along y) of the scan plane each scan has the centre; 'sphere' needs none"
    )
    if data.touches is None or data.tip is None:
        raise InputError(
            "The compensation needs touches. Give 'touch_T' and 'tip' in the file, or --touches and --tip."
        )
    check_number(data.poses, sign.shape, "signs")
    check_radius(data, SphereSigmas(), None)
    if "translated" in file.arrays:
        translated = file.arrays["translated"] > 0.5
    else:
        group = rotation_groups(data.poses)
        translated = np.asarray(group == np.bincount(group).argmax(), bool)
    centers = np.array(
        [published.sphere_center(fit_circle(p)[0], data.radius_m, s) for p, s in zip(data.profiles, sign, strict=True)]
    )
    R, t = data.poses.rotation, data.poses.translation
    linear = published.sphere_linear(R, t, centers, translated)
    felt = published.fit_touch_sphere(
        data.touches.rotation, data.touches.translation, data.tip, data.radius_m, solve_tip=solve_tip
    )
    best = published.compensate(linear, R, t, centers, felt.center)

    def off(rotation: Floats, translation: Floats) -> float:
        at = np.einsum("nij,nj->ni", R, centers @ rotation.T + translation) + t
        return 1e3 * float(np.linalg.norm(at - felt.center, axis=1).mean())

    found = {
        "scans": len(R),
        "touches": len(data.touches),
        "touch_rms_mm": 1e3 * felt.rms_m,
        "centre_before_mm": off(linear.rotation, linear.translation),
        "centre_after_mm": off(best.rotation, best.translation),
        "wrong_sides": list(published.wrong_sides(R, t, centers, translated)),
    }
    record = ProfilerRecord(
        method="sphere, linear and compensated",
        rotation=best.rotation,
        translation=best.translation,
        tip=felt.tip,
        figures=found,
        data_sha256=file.digest,
    )
    return record, found
