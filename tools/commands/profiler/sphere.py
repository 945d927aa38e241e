"""weldcal profiler sphere and compensate: the pose on the flange from profiles of a sphere, by joint fit or touches."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np

from weldcal.calibration.errors import ArcNotFound, InconsistentData
from weldcal.calibration.geometry.se3 import pose
from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.combined.scans import FeatureScans, sphere_scans
from weldcal.calibration.profiler.combined.solve import solve_joint
from weldcal.calibration.profiler.motion import FlangePoses, Floats, rotation_groups
from weldcal.calibration.profiler.plan import Field, plan_sphere_poses, sample_sphere_poses
from weldcal.calibration.profiler.reading_choice import sphere_fit
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sensor import SensorCorrection
from weldcal.calibration.profiler.sphere import linear as published
from weldcal.calibration.profiler.sphere.arc import find_arc, fit_circle
from weldcal.calibration.profiler.sphere.joint import (
    SCALE_SIGMAS,
    Model,
    SphereEstimate,
    check_radius,
    choose_model,
    leave_one_out_m,
    sphere_joint,
)
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.arms.dh import dh_parameters
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools import console
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.files import Measurements, PosesStated, read_profiler_file
from weldcal.tools.commands.profiler.result import (
    CANDIDATES,
    FileArgument,
    PlanOption,
    PosesOption,
    RadiusOption,
    Sigmas,
    TipOption,
    TouchesOption,
    UnitOption,
    check_number,
    figures_of,
    finish,
    next_poses,
    outcome_of,
    read_measurements,
    stated_correction,
    widened,
    with_warnings,
)
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.profiler_file import ProfilerFile

POORLY = 1.5  # reduced chi-square from which another convention of the poses is tried
RADIUS_OFF_M = 0.1e-3
OTHER_SIGMAS, OTHER_SENSOR = 5.0, 0.01  # a choice: an arm's errors look like 0.5 % of scale
_LONGEST_TORCH_M = 10.0
ALL_ARC_M = 0.5e-3  # a profile off one circle by less holds the sphere only
MODELS = ("auto", "rigid", "affine", "affine+joints")


@command(
    "profiler sphere",
    keys=("robot-form", "set", "trial", "pitch", "sensor-correction", "sigma-robot", "sigma-z"),
    short_help="Calibrate by a sphere, with or without touches of it.",
)
def sphere(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    poses: PosesOption = None,
    radius: RadiusOption = None,
    model: Annotated[str, option("--model", "M", "auto, rigid, affine or affine+joints.")] = "auto",
    arm: Annotated[str, option("--arm", "NAME", "Arm whose kinematic table is used, for example ur10e.")] = "",
    touches: TouchesOption = None,
    tip: TipOption = "",
    plan: PlanOption = 0,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by raw profiles of a sphere. Needs no initial guess, no scan sides
    and no pure translations."""
    check_limit(limit_mm)
    robot_m, z_m = (1e-3 * call.reading.get(key, usual) for key, usual in (("sigma-robot", 0.03), ("sigma-z", 0.05)))
    sigmas = Sigmas(robot_m, z_m, z_m)
    lost: list[int] = []
    data, measured = read_sphere(call, file, unit, poses, radius, touches, tip, arm, lost)
    measured = replace(measured, sensor=stated_correction(call, measured.profiles))
    record, found = calibrate_sphere(measured, data.digest, sigmas, model=model, plan=plan, seed=call.seed)
    made, summary = finish_sphere(
        measured,
        SphereSigmas(sensor_m=sigmas.z_m, robot_m=sigmas.robot_m),
        record,
        with_warnings(data, found) | {"without_sphere": lost},
        file.name,
        call.folder("profiler", file.stem),
        limit_mm,
    )
    return outcome_of(call, summary, made)


def read_sphere(
    call: Call,
    file: Path,
    unit: str | None,
    poses: Path | None,
    radius: float | None,
    touches: Path | None,
    tip: str,
    arm: str = "",
    lost: list[int] | None = None,
) -> tuple[Measurements, SphereData]:
    """Return the measurements of a sphere and its touches, with the reading of the poses that the arcs select."""
    tip_m = parse_tip(tip)
    data, form = read_measurements(call, file, unit, poses), call.reading.get("robot-form", "")
    felt = None if touches is None else read_profiler_file(touches, unit=unit, stated=PosesStated(form=form))
    radius_m = None if radius is None else 1e-3 * radius
    return decided_sphere(data, felt, radius_m=radius_m, arm=arm, tip_m=tip_m, lost=lost, seed=call.seed)


def decided_sphere(
    data: Measurements,
    felt: Measurements | None = None,
    *,
    radius_m: float | None,
    arm: str = "",
    tip_m: Floats | None = None,
    lost: list[int] | None = None,
    seed: int = 0,
) -> tuple[Measurements, SphereData]:
    """Return measurements and their sphere with the reading of the poses that the arcs select; see sphere_data."""
    lost = [] if lost is None and len(data.readings) > 1 else lost
    found = sphere_data(data, radius_m=radius_m, arm=arm, tip_m=tip_m, touches=felt, lost=lost, seed=seed)
    if len(data.readings) > 1:
        kept = np.setdiff1d(np.arange(len(data.readings[0].X)), lost or [])
        fit = sphere_fit(found.profiles, found.radius_m)
        data = data.decided(lambda poses: fit(poses[kept]), "sphere")
        if felt is not None:
            felt = felt.with_form(data.readings[0].form)
        found = replace(
            found,
            poses=cast(FlangePoses, data.poses())[kept],
            touches=None if found.touches is None or felt is None else felt.poses(),
        )
    return data, found


def sphere_data(
    file: Measurements,
    *,
    radius_m: float | None,
    arm: str = "",
    tip_m: Floats | None = None,
    touches: Measurements | None = None,
    lost: list[int] | None = None,
    seed: int = 0,
) -> SphereData:
    """Return a file's measurements of a sphere: the detected arcs, with touches and joints where there are any.

    Scans without an arc are not used and their numbers added to `lost`; without that list they are refused.
    """
    if file.profiles is None:
        raise InputError("The file has no 'profiles' of the sphere. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    radius = radius_m if radius_m is not None else float(file.needed("radius", "the sphere's (or give --radius in mm)"))
    if not 1e-3 <= radius <= 1.0:
        raise InputError(f"A sphere of {1e3 * radius:.3g} mm radius cannot be used. Give --radius in mm.")
    felt = touches.poses() if touches is not None else file.poses("touch_")
    tip = tip_m if tip_m is not None else file.arrays.get("tip")
    if felt is not None and tip is None:
        raise InputError("There are touches but no tip. Give its position in the flange frame as --tip x,y,z in mm.")
    table = DhArm(dh_parameters(load_arm(arm))) if arm else file.arm()
    poses = cast(FlangePoses, file.poses())
    check_number(poses, (len(file.profiles),), "profiles")
    profiles, kept = [], []
    for k, p in enumerate(file.profiles):
        try:
            profiles.append(arc_of(p, radius, seed))
            kept.append(k)
        except ArcNotFound as e:
            if lost is None:
                raise ArcNotFound(f"Scan {k} shows no arc of the sphere. Remove it from the file.") from e
            lost.append(k)
    if not kept:
        raise ArcNotFound("No scan shows an arc of the sphere. Check the radius, the unit and which column is z.")
    q = file.arrays.get("q")
    if q is not None:
        check_number(poses, (len(q),), "joint vectors q")
    return SphereData(
        poses=poses[np.array(kept)],
        profiles=profiles,
        radius_m=radius,
        touches=felt,
        tip=tip if felt is not None else None,
        arm=table,
        q=None if q is None else q[kept],
        touch_q=file.arrays.get("touch_q"),
    )


def parse_tip(text: str) -> Floats | None:
    """Return the tip (3,) m of the option --tip, "x,y,z" in mm; None where it is empty.

    Raises:
        InputError: not three numbers.
    """
    if not text:
        return None
    try:
        x, y, z = (1e-3 * float(v) for v in text.split(","))
    except ValueError as e:
        raise InputError(f"The tip is three numbers in mm with commas between, as --tip 0,0,150, not '{text}'.") from e
    tip = np.array([x, y, z])
    if not (np.abs(tip) <= _LONGEST_TORCH_M).all():
        raise InputError(f"The tip lies within {1e3 * _LONGEST_TORCH_M:.0f} mm of the flange; '{text}' does not.")
    return tip


def arc_of(profile: Floats, radius_m: float, seed: int) -> Floats:
    """Return the sphere's points of a profile: all of them where they form one arc, else those detected."""
    p = profile[np.isfinite(profile).all(axis=1)]
    if len(p) >= 5:
        circle, rms = fit_circle(p)
        if rms < ALL_ARC_M and circle[2] < 1.05 * radius_m and len(np.unique(p[:, 1] < circle[1])) == 1:
            return p
    return np.asarray(profile[find_arc(profile, radius_m, seed=seed)[0]])


def calibrate_sphere(
    data: SphereData, digest: str, sigmas: Sigmas, *, model: str = "auto", plan: int = 0, seed: int = 0
) -> tuple[ProfilerRecord, dict[str, Any]]:
    """X_FS from a sphere in any poses, by the model with the smallest held-out error (or the one named)."""
    if model not in MODELS:
        raise InputError(f"The model is one of {', '.join(MODELS)}, not '{model}'.")
    s = SphereSigmas(sensor_m=sigmas.z_m, robot_m=sigmas.robot_m)
    found: dict[str, Any] = {"scans": len(data.poses), "touches": 0 if data.touches is None else len(data.touches)}
    scans = data.scans(data.radius_m)
    rigid = _rigid(scans, s)
    check_radius(scans, s, rigid)
    _refuse_inverse_poses(scans, rigid, s)
    chosen = cast(Model, model)
    if model == "auto":
        full = data.arm is not None and data.q is not None and (data.touches is None or data.touch_q is not None)
        choice = choose_model(data if full else _without_arm(data), s)
        chosen = choice.model
        found["left_out_rms_mm"] = {name: 1e3 * v for name, v in choice.left_out_m.items()}
        found["model_reason"] = choice.reason
    e = widened(sphere_joint(data, chosen, s))
    if data.sensor is not None:
        _refuse_other_sensor(data, data.sensor, s, e)
        found["sensor_correction"] = data.sensor.data_sha256
    if chosen != "affine+joints":  # which has the arm's errors as its unknowns
        S = s.affine**2 * np.eye(3) if data.sensor is None else data.sensor.covariance
        whole = solve_joint([sphere_part(data, e, e.origin)], S)
        e, found["arm_mm"] = replace(e, covariance=e.covariance + whole.by_arm), 1e3 * whole.arm_m
    found |= {"model": chosen} | figures_of(e)
    found["wrong_scans"] = list(e.wrong_poses)
    # to first order, and so only where it is near the stated one
    known = abs(e.radius_change_m) <= SCALE_SIGMAS * s.affine * data.radius_m
    found["radius_of_profiles_mm"] = 1e3 * (data.radius_m + e.radius_change_m) if known else None
    found["warnings"] = _warnings(e, data, s)
    if plan:
        if np.median([fit_circle(p)[0][1] - np.median(p[:, 1]) for p in data.profiles]) < 0.0:
            raise InputError(
                "Planning needs z pointing away from the sensor. Change the sign of z, and of x to keep the frame"
                " right-handed, in the file."
            )
        seen = np.vstack(data.profiles)
        near, far = (float(v) for v in np.percentile(seen[:, 1], [1.0, 99.0]))
        field = Field(float(np.percentile(np.abs(seen[:, 0]), 99.0)), near, max(far, near + 5e-3))
        candidates = sample_sphere_poses(e.rotation, e.translation, e.center, data.radius_m, CANDIDATES, seed, field)
        best = plan_sphere_poses(
            e.rotation, e.translation, e.center, data.radius_m, data.poses, candidates, plan, sigmas=s, field=field
        )
        found["next_poses"] = next_poses(candidates, best.chosen, best.rms_m)
    arm = data.arm if chosen == "affine+joints" else None
    return ProfilerRecord.of(f"sphere, {chosen}", e, found, digest, arm), found


def sphere_part(data: SphereData, e: SphereEstimate, origin: Floats) -> FeatureScans:
    """Return the scans of a sphere about an estimate, without wrong scans; ``origin`` (2,) m: of scale and shear."""
    kept = data.without(*e.wrong_poses)
    arcs = [p[np.isfinite(p).all(axis=1)] for p in kept.profiles]
    return sphere_scans(kept.poses, arcs, data.radius_m, e.center, pose(e.rotation, e.translation), origin)


def _refuse_other_sensor(data: SphereData, sensor: SensorCorrection, s: SphereSigmas, e: SphereEstimate) -> None:
    """Refuse a sensor correction that the sphere contradicts.

    Raises:
        InconsistentData: the sphere alone shows clearly other scales.
    """
    free = sphere_joint(replace(_without_arm(data), sensor=None), "affine", s, init=replace(e, affine=np.zeros(3)))
    k = 9 + 3 * (data.touches is not None)
    spread = sensor.covariance + free.whole[k : k + 3, k : k + 3] * max(1.0, free.reduced_chi2, free.scans_chi2)
    off = np.abs(free.affine - sensor.values)
    if ((off > OTHER_SIGMAS * np.sqrt(np.diag(spread))) & (off > OTHER_SENSOR)).any():
        mine, theirs = (", ".join(f"{100.0 * v:+.2f} %" for v in a) for a in (free.affine, sensor.values))
        raise InconsistentData(
            f"The sphere shows x scale, z scale and shear of {mine}, and the sensor correction states {theirs}: it is"
            " another sensor's. Run 'weldcal profiler step' with this sensor, or omit the correction."
        )


def _refuse_inverse_poses(scans: SphereData, rigid: SphereEstimate | None, s: SphereSigmas) -> None:
    """Refuses poses of the base in the flange instead of the flange in the base.

    Raises:
        InputError: the inverse poses fit the profiles far better.
    """
    chi2 = float("inf") if rigid is None else rigid.reduced_chi2
    if chi2 < POORLY:
        return
    R, p = scans.poses.rotation, scans.poses.translation
    inverse = FlangePoses(np.swapaxes(R, 1, 2), -np.einsum("nji,nj->ni", R, p))
    other = _rigid(replace(scans, poses=inverse), s)
    if other is not None and other.reduced_chi2 < 0.4 * chi2:
        raise InputError(
            "The inverses of the poses fit the profiles. Give the flange in the base, not the base in the flange."
        )


def _rigid(scans: SphereData, s: SphereSigmas) -> SphereEstimate | None:
    """Return the rigid model's estimate; None where it refuses."""
    try:
        return sphere_joint(scans, "rigid", s)
    except WeldcalError:
        return None


def _warnings(e: SphereEstimate, data: SphereData, s: SphereSigmas) -> list[str]:
    said = []
    known = abs(e.radius_change_m) <= SCALE_SIGMAS * s.affine * data.radius_m
    if known and abs(e.radius_change_m) > max(4.0 * e.radius_sigma_m, RADIUS_OFF_M):
        said.append(
            f"The profiles show a sphere of {1e3 * (data.radius_m + e.radius_change_m):.2f} mm instead of "
            f"{1e3 * data.radius_m:.2f}. Check the radius and the profiler's scale."
        )
    if e.tip is not None and data.tip is not None and np.linalg.norm(e.tip - data.tip) > 3.0 * s.tip_m:
        said.append(
            f"The touches put the tip {1e3 * float(np.linalg.norm(e.tip - data.tip)):.0f} mm from its given position."
            " Check --tip."
        )
    return said


def _without_arm(data: SphereData) -> SphereData:
    return replace(data, arm=None, q=None, touch_q=None)


def finish_sphere(
    data: SphereData,
    sigmas: SphereSigmas,
    record: ProfilerRecord,
    found: dict[str, Any],
    source: str,
    out: Path,
    limit_mm: float | None,
) -> tuple[ProfilerFile, dict[str, Any]]:
    """Write a sphere's calibration and its report; the result, and its JSON object without the folder."""
    held = np.zeros(0)
    if "model" in found:  # the published method cannot leave a scan out
        model = cast(Model, found["model"])
        whole = data if model == "affine+joints" else replace(data, arm=None, q=None, touch_q=None)
        try:
            held = 1e3 * leave_one_out_m(whole, model, sigmas)
        except WeldcalError:  # too few scans to leave any out
            held = np.zeros(0)
        used = np.ones(len(held), bool)
        used[[k for k in found.get("wrong_scans", ()) if k < len(held)]] = False
        held = held[used]
    return finish(record, found, np.vstack(data.profiles), held, source, out, limit_mm)


@command(
    "profiler compensate",
    keys=("robot-form", "set", "trial", "pitch"),
    short_help="Calibrate by the published sphere method.",
)
def compensate(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    poses: PosesOption = None,
    radius: RadiusOption = None,
    touches: TouchesOption = None,
    tip: TipOption = "",
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate by the sphere paper's two linear steps and its compensation. 'sphere' is more accurate on the same
    file."""
    check_limit(limit_mm)
    data, measured = read_sphere(call, file, unit, poses, radius, touches, tip)
    record, found = calibrate_compensate(data, measured)
    if found["wrong_sides"]:
        console.emit_warning(
            f"The side of the sphere's centre is likely wrong in scans {found['wrong_sides']}. Check their sign."
        )
    folder = call.folder("profiler", file.stem)
    made, summary = finish_sphere(
        measured, SphereSigmas(), record, with_warnings(data, found), file.name, folder, limit_mm
    )
    return outcome_of(call, summary, made)


def calibrate_compensate(file: Measurements, data: SphereData) -> tuple[ProfilerRecord, dict[str, Any]]:
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
    felt = published.fit_touch_sphere(data.touches.rotation, data.touches.translation, data.tip, data.radius_m)
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
