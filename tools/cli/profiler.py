"""weldcal profiler: a laser profiler on the flange, calibrated from files, and a seam mapped with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldcal.tools import console
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option, switch

if TYPE_CHECKING:
    from weldcal.calibration.profiler.sphere.model import SphereData
    from weldcal.tools.commands.profiler.files import Measurements
    from weldcal.tools.report.profiler_file import ProfilerFile as ProfilerResult
    from weldcal.tools.report.profiler_file import ProfilerSeam

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Measurements, .npz or .csv (docs/profiler.md).")]
UnitOption = Annotated[str | None, option("--unit", "U", "m or mm, for an NPZ that does not state its unit.")]
SetOption = Annotated[str, option("--set", "NAME", "Which set of an NPZ with several.")]
TrialOption = Annotated[int | None, option("--trial", "K", "Which trial or world of an NPZ with several.")]
ROBOT_SIGMA, Z_SIGMA = "Standard deviation of the robot's position per axis.", "Standard deviation of a point in depth."
ESTIMATED = "the file's, else estimated from the points, at least {}"
PlanOption = Annotated[int, option("--plan", "N", "Also propose N poses to add next.", min=0)]
RadiusOption = Annotated[float | None, option("--radius", "MM", "Radius of the sphere, if the file has none.")]
TouchesOption = Annotated[Path | None, option("--touches", "FILE", "CSV of flange poses at touches of the sphere.")]
TipOption = Annotated[str, option("--tip", "X,Y,Z", "The torch's tip in the flange frame, mm.")]


@command("profiler edge", short_help="Calibrate by one straight edge.")
def edge(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    method: Annotated[str, option("--method", "M", "joint, or paper (the published linear method).")] = "joint",
    feature: Annotated[str, option("--feature", "KIND", "For raw profiles: bar, step or apex.")] = "",
    side: Annotated[str, option("--side", "S", "End of the near face: left or right.")] = "left",
    sigma_robot: Annotated[
        float | None, option("--sigma-robot", "MM", ROBOT_SIGMA, show_default=ESTIMATED.format(0.03))
    ] = None,
    sigma_x: Annotated[
        float | None,
        option(
            "--sigma-x",
            "MM",
            "Standard deviation of a point along the laser line.",
            show_default=ESTIMATED.format(0.05),
        ),
    ] = None,
    sigma_z: Annotated[float | None, option("--sigma-z", "MM", Z_SIGMA, show_default=ESTIMATED.format(0.06))] = None,
    plan: PlanOption = 0,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by points of one straight edge, seen in any poses. Needs no initial guess."""
    from weldcal.tools.commands.profiler.calibrate import calibrate_edge
    from weldcal.tools.commands.profiler.files import read_profiler_file
    from weldcal.tools.commands.profiler.noise import Sigmas
    from weldcal.tools.commands.profiler.results import finish_edge
    from weldcal.tools.outcomes.first_screen import check_limit

    check_limit(limit_mm)
    given, usual = (sigma_robot, sigma_x, sigma_z), (0.03, 0.05, 0.06)
    robot, x, z = (1e-3 * (u if v is None else v) for v, u in zip(given, usual, strict=True))
    sigmas = Sigmas(robot, x, z, stated=any(v is not None for v in given))
    data = read_profiler_file(file, unit=unit, dataset=dataset, trial=trial)
    record, found = calibrate_edge(data, sigmas, method=method, feature=feature, side=side, plan=plan, seed=call.seed)
    made, summary = finish_edge(
        data, feature, side, record, _with(data, found), file.name, call.folder("profiler", file.stem), limit_mm
    )
    return _outcome(call, summary, made)


@command("profiler sphere", short_help="Calibrate by a sphere, with or without touches of it.")
def sphere(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    radius: RadiusOption = None,
    model: Annotated[str, option("--model", "M", "auto, rigid, affine or affine+joints.")] = "auto",
    arm: Annotated[str, option("--arm", "NAME", "Arm whose kinematic table is used, for example ur10e.")] = "",
    touches: TouchesOption = None,
    tip: TipOption = "",
    sigma_robot: Annotated[float, option("--sigma-robot", "MM", ROBOT_SIGMA)] = 0.03,
    sigma_z: Annotated[float, option("--sigma-z", "MM", Z_SIGMA)] = 0.05,
    plan: PlanOption = 0,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by raw profiles of a sphere. Needs no initial guess, no scan sides and no
    pure translations."""
    from weldcal.calibration.profiler.sphere.model import SphereSigmas
    from weldcal.tools.commands.profiler.calibrate import calibrate_sphere
    from weldcal.tools.commands.profiler.noise import Sigmas
    from weldcal.tools.commands.profiler.results import finish_sphere
    from weldcal.tools.outcomes.first_screen import check_limit

    check_limit(limit_mm)
    sigmas = Sigmas(1e-3 * sigma_robot, 1e-3 * sigma_z, 1e-3 * sigma_z)
    lost: list[int] = []
    data, measured = _sphere(call, file, unit, dataset, trial, radius, touches, tip, arm, lost)
    record, found = calibrate_sphere(measured, data.digest, sigmas, model=model, plan=plan, seed=call.seed)
    made, summary = finish_sphere(
        measured, SphereSigmas(sensor_m=sigmas.z_m, robot_m=sigmas.robot_m), record,
        _with(data, found) | {"without_sphere": lost}, file.name, call.folder("profiler", file.stem), limit_mm,
    )  # fmt: skip
    return _outcome(call, summary, made)


@command("profiler compensate", short_help="Calibrate by the published sphere method.")
def compensate(
    call: Call,
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    radius: RadiusOption = None,
    touches: TouchesOption = None,
    tip: TipOption = "",
    solve_tip: Annotated[
        bool, switch("--solve-tip", "Also estimate the tip from the touches (not in the paper).")
    ] = False,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate by the sphere paper's two linear steps and its compensation. 'sphere' is more accurate on the same file."""
    from weldcal.calibration.profiler.sphere.model import SphereSigmas
    from weldcal.tools.commands.profiler.calibrate import calibrate_compensate
    from weldcal.tools.commands.profiler.results import finish_sphere
    from weldcal.tools.outcomes.first_screen import check_limit

    check_limit(limit_mm)
    data, measured = _sphere(call, file, unit, dataset, trial, radius, touches, tip)
    record, found = calibrate_compensate(data, measured, solve_tip=solve_tip)
    if found["wrong_sides"]:
        console.emit_warning(
            f"The side of the sphere's centre is likely wrong in scans {found['wrong_sides']}. Check their sign."
        )
    folder = call.folder("profiler", file.stem)
    made, summary = finish_sphere(measured, SphereSigmas(), record, _with(data, found), file.name, folder, limit_mm)
    return _outcome(call, summary, made)


@command("profiler seam", short_help="Map a V-groove in the base frame.")
def seam(
    call: Call,
    file: FileArgument,
    calibration: Annotated[Path, option("--calibration", "FOLDER", "Result folder of edge, sphere or compensate.")],
    unit: UnitOption = None,
    trial: TrialOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Map both edges and the root of a V-groove from raw profiles into the base frame, as seam.csv."""
    from weldcal.tools.commands.profiler.files import read_profiler_file
    from weldcal.tools.commands.profiler.seam import finish_seam, map_seam
    from weldcal.tools.outcomes.first_screen import check_limit

    check_limit(limit_mm)
    folder = call.folder("profiler", file.stem)
    data = read_profiler_file(file, unit=unit, trial=trial)
    found = _with(data, map_seam(data, calibration, folder))
    return _outcome(call, found, finish_seam(found, calibration, file.name, folder, limit_mm))


@command("profiler clock", short_help="Find a profiler's clock from a straight edge.")
def clock(
    call: Call,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="stream.csv of the robot and profiles.csv (time,x,z).")
    ],
    calibration: Annotated[Path, option("--calibration", "RESULT", "Result folder of edge, sphere or compensate.")],
    robot: Annotated[str, option("--arm", "NAME", "The arm of a stream of joint angles.")] = "",
    unit: Annotated[str, option("--unit", "U", "m or mm, of the profiles and of the stream's positions.")] = "m",
    feature: Annotated[
        str, option("--feature", "KIND", "Where a time has many rows, the edge in them: bar, step or apex.")
    ] = "bar",
    side: Annotated[str, option("--side", "S", "End of the near face: left or right.")] = "left",
) -> Outcome:
    """Find the offset of a profiler's clock while the arm weaves across one straight edge: capture = stamp - offset."""
    from weldcal.tools.commands.profiler.clock import find_clock

    out = call.folder("profiler", folder.resolve().name)
    return Outcome(find_clock(folder, calibration, out, robot=robot, unit=unit, feature=feature, side=side))


def _sphere(
    call: Call,
    file: Path,
    unit: str | None,
    dataset: str,
    trial: int | None,
    radius: float | None,
    touches: Path | None,
    tip: str,
    arm: str = "",
    lost: list[int] | None = None,
) -> tuple[Measurements, SphereData]:
    from weldcal.tools.commands.profiler.calibrate import parse_tip, sphere_data
    from weldcal.tools.commands.profiler.files import read_profiler_file

    tip_m = parse_tip(tip)
    data = read_profiler_file(file, unit=unit, dataset=dataset, trial=trial)
    felt = None if touches is None else read_profiler_file(touches, unit=unit)
    radius_m = None if radius is None else 1e-3 * radius
    return data, sphere_data(data, radius_m=radius_m, arm=arm, tip_m=tip_m, touches=felt, lost=lost, seed=call.seed)


def _with(data: Measurements, found: Mapping[str, Any]) -> dict[str, Any]:
    """What was found, with the warnings about the file first."""
    return {**found, **({"warnings": [*data.warnings, *found.get("warnings", [])]} if data.warnings else {})}


def _outcome(call: Call, found: Mapping[str, object], made: ProfilerResult | ProfilerSeam) -> Outcome:
    warnings = found.get("warnings")
    # the first screen has them, and the JSON object has no first screen
    for sentence in warnings if isinstance(warnings, list) and call.json else []:
        console.emit_warning(str(sentence))
    rows: dict[str, str] = {}
    for key in ("outlier_scans", "wrong_scans", "without_feature", "without_sphere", "without_groove", "wrong_sides"):
        numbers = found.get(key)
        if isinstance(numbers, list) and numbers:
            rows[key.replace("_", " ")] = ", ".join(map(str, numbers))
    after = found.get("next_poses")
    if isinstance(after, dict):
        for k, pose in enumerate(after["poses"]):
            place = ", ".join(f"{1e3 * v:.1f}" for v in pose[:3])
            turn = ", ".join(f"{v:.4f}" for v in pose[3:])
            left = after["rms_before_and_after_each_mm"]
            rows[f"add pose {k + 1}"] = f"{place} mm, {turn} rad: {left[k]:.3f} to {left[k + 1]:.3f} mm in the field"
    values = {k: v for k, v in found.items() if v != [] and k != "warnings"}
    return Outcome({"state": "done", **found, "written_to": str(made.out)}, values, rows, first=made.first)
