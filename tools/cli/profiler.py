"""weldcal profiler: a laser profiler on the flange, calibrated from files, and a seam mapped with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from weldcal.tools import console

profiler = typer.Typer(help="A laser profiler on the flange: by an edge, by a sphere; a seam.", no_args_is_help=True)

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Measurements, .npz or .csv (docs/profiler.md).")]
UnitOption = Annotated[str | None, typer.Option("--unit", metavar="U", help="m or mm: of an NPZ that does not say.")]
SetOption = Annotated[str, typer.Option("--set", metavar="NAME", help="Of an NPZ with several sets.")]
TrialOption = Annotated[
    int | None, typer.Option("--trial", metavar="K", help="Of an NPZ with several trials or worlds.")
]
RobotSigma = Annotated[
    float, typer.Option("--sigma-robot", metavar="MM", help="The robot's position, one sigma per axis.")
]
ZSigma = Annotated[float, typer.Option("--sigma-z", metavar="MM", help="A profile point in depth, one sigma.")]
OF_POINTS = "the file's, else what the points show, {} at least"
EdgeRobotSigma = Annotated[
    float | None,
    typer.Option(
        "--sigma-robot",
        metavar="MM",
        help="The robot's position, one sigma per axis.",
        show_default=OF_POINTS.format(0.03),
    ),
]
EdgeXSigma = Annotated[
    float | None,
    typer.Option(
        "--sigma-x",
        metavar="MM",
        help="A profile point along the line, one sigma.",
        show_default=OF_POINTS.format(0.05),
    ),
]
EdgeZSigma = Annotated[
    float | None,
    typer.Option(
        "--sigma-z", metavar="MM", help="A profile point in depth, one sigma.", show_default=OF_POINTS.format(0.06)
    ),
]
PlanOption = Annotated[int, typer.Option("--plan", metavar="N", min=0, help="Also name N poses to add next.")]
RadiusOption = Annotated[
    float | None, typer.Option("--radius", metavar="MM", help="The sphere's, where the file has none.")
]
TouchesOption = Annotated[
    Path | None, typer.Option("--touches", metavar="FILE", help="CSV of flange poses at touches.")
]
TipOption = Annotated[str, typer.Option("--tip", metavar="X,Y,Z", help="The torch's tip in the flange frame, mm.")]
ArmOption = Annotated[str, typer.Option("--arm", metavar="NAME", help="Arm whose table is used, as ur10e.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FOLDER", help="Where to write; default: a new one in weldcal-out.")
]
SeedOption = Annotated[
    int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from this number.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")]


@profiler.callback()
def _group() -> None:
    """A laser profiler on the flange: by an edge, by a sphere; a seam."""


@profiler.command("edge", short_help="X_FS from one straight edge.")
def edge(
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    method: Annotated[
        str, typer.Option("--method", metavar="M", help="joint, or paper (its linear method).")
    ] = "joint",
    feature: Annotated[str, typer.Option("--feature", metavar="KIND", help="In raw profiles: bar, step or apex.")] = "",
    side: Annotated[str, typer.Option("--side", metavar="S", help="End of the near face: left or right.")] = "left",
    sigma_robot: EdgeRobotSigma = None,
    sigma_x: EdgeXSigma = None,
    sigma_z: EdgeZSigma = None,
    plan: PlanOption = 0,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The profiler's pose on the flange, from points of one straight edge seen in any poses; no guess is needed."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.profiler.calibrate import calibrate_edge, write_calibration
        from weldcal.tools.commands.profiler.files import read_profiler_file
        from weldcal.tools.commands.profiler.noise import Sigmas

        given, usual = (sigma_robot, sigma_x, sigma_z), (0.03, 0.05, 0.06)
        robot, x, z = (1e-3 * (u if v is None else v) for v, u in zip(given, usual, strict=True))
        sigmas = Sigmas(robot, x, z, stated=any(v is not None for v in given))
        data = read_profiler_file(file, unit=unit, dataset=dataset, trial=trial)
        record, found = calibrate_edge(data, sigmas, method=method, feature=feature, side=side, plan=plan, seed=seed)
        folder = _folder(out, file, seed)
        found |= write_calibration(record, folder)
    _report("profiler edge", found, folder, json)


@profiler.command("sphere", short_help="X_FS from a sphere, with touches where there are any.")
def sphere(
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    radius: RadiusOption = None,
    model: Annotated[str, typer.Option("--model", metavar="M", help="auto, rigid, affine or affine+joints.")] = "auto",
    arm: ArmOption = "",
    touches: TouchesOption = None,
    tip: TipOption = "",
    sigma_robot: RobotSigma = 0.03,
    sigma_z: ZSigma = 0.05,
    plan: PlanOption = 0,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The profiler's pose on the flange, from raw profiles of a sphere; no sides, no pure translations, no guess."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.profiler.calibrate import calibrate_sphere, write_calibration
        from weldcal.tools.commands.profiler.noise import Sigmas

        sigmas = Sigmas(1e-3 * sigma_robot, 1e-3 * sigma_z, 1e-3 * sigma_z)
        lost: list[int] = []
        data, measured = _sphere(file, unit, dataset, trial, radius, arm, touches, tip, seed, lost)
        record, found = calibrate_sphere(measured, data.digest, sigmas, model=model, plan=plan, seed=seed)
        found["without_sphere"] = lost
        folder = _folder(out, file, seed)
        found |= write_calibration(record, folder)
    _report("profiler sphere", found, folder, json)


@profiler.command("compensate", short_help="The sphere paper's method and its compensation by touches.")
def compensate(
    file: FileArgument,
    unit: UnitOption = None,
    dataset: SetOption = "",
    trial: TrialOption = None,
    radius: RadiusOption = None,
    touches: TouchesOption = None,
    tip: TipOption = "",
    solve_tip: Annotated[
        bool, typer.Option("--solve-tip", help="The tip from the same touches (not in the paper).")
    ] = False,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """The sphere paper's own two steps and its compensation; 'sphere' does better from the same file."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.profiler.calibrate import calibrate_compensate, write_calibration

        data, measured = _sphere(file, unit, dataset, trial, radius, "", touches, tip, seed)
        record, found = calibrate_compensate(data, measured, solve_tip=solve_tip)
        folder = _folder(out, file, seed)
        found |= write_calibration(record, folder)
    if found["wrong_sides"]:
        console.emit_warning(
            f"The side of the sphere's centre is likely wrong in scans {found['wrong_sides']}: check their sign."
        )
    _report("profiler compensate", found, folder, json)


@profiler.command("seam", short_help="A V-groove's features in the base frame.")
def seam(
    file: FileArgument,
    calibration: Annotated[
        Path, typer.Option("--calibration", metavar="FOLDER", help="Written by edge, sphere or compensate.")
    ],
    unit: UnitOption = None,
    trial: TrialOption = None,
    out: OutOption = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Both edges and the root of a V-groove in every raw profile, in the base frame, as seam.csv."""
    with console.boundary(json_wanted=json, debug=debug):
        from weldcal.tools.commands.profiler.calibrate import map_seam
        from weldcal.tools.commands.profiler.files import read_profiler_file

        folder = _folder(out, file, seed)
        found = map_seam(read_profiler_file(file, unit=unit, trial=trial), calibration, folder)
    _report("profiler seam", found, folder, json)


def _sphere(
    file: Path,
    unit: str | None,
    dataset: str,
    trial: int | None,
    radius: float | None,
    arm: str,
    touches: Path | None,
    tip: str,
    seed: int,
    lost: list[int] | None = None,
) -> tuple[Any, Any]:
    import numpy as np

    from weldcal.models.errors import InputError
    from weldcal.tools.commands.profiler.calibrate import sphere_data
    from weldcal.tools.commands.profiler.files import read_profiler_file

    try:
        tip_m = 1e-3 * np.array([float(v) for v in tip.split(",")]) if tip else None
    except ValueError as e:
        raise InputError(f"The tip is three numbers in mm with commas between, as --tip 0,0,150, not '{tip}'.") from e
    if tip_m is not None and tip_m.shape != (3,):
        raise InputError(f"The tip is three numbers in mm with commas between, as --tip 0,0,150, not '{tip}'.")
    data = read_profiler_file(file, unit=unit, dataset=dataset, trial=trial)
    felt = None if touches is None else read_profiler_file(touches, unit=unit)
    radius_m = None if radius is None else 1e-3 * radius
    return data, sphere_data(data, radius_m=radius_m, arm=arm, tip_m=tip_m, touches=felt, lost=lost, seed=seed)


def _folder(out: Path | None, file: Path, seed: int) -> Path:
    from weldcal.tools.cli.options import fresh_folder

    return out or fresh_folder("profiler", file.stem, seed)


def _pose_rows(X_FS: list[list[float]]) -> dict[str, str]:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix([row[:3] for row in X_FS[:3]]).as_euler("xyz", degrees=True)
    return {
        "X_FS": "pose of the scan plane in the flange frame",
        "position": "  ".join(f"{1e3 * row[3]:+.3f}" for row in X_FS[:3]) + "  mm",
        "roll pitch yaw": "  ".join(f"{v:+.4f}" for v in turn) + "  deg",
    }


def _report(command: str, found: Mapping[str, object], folder: Path, json: bool) -> None:
    from weldcal.tools.cli.options import finish

    rows: dict[str, str] = {}
    X = found.get("X_FS")
    if isinstance(X, list):
        rows |= _pose_rows(X)
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
    warnings = found.get("warnings")
    for sentence in warnings if isinstance(warnings, list) else []:
        console.emit_warning(str(sentence))
    summary = {"state": "done", **{k: v for k, v in found.items() if v != [] and k != "warnings"}}
    if json:
        summary = {"state": "done", **found, "written_to": str(folder)}
    finish(command, summary, folder, json_wanted=json, rows=rows)
