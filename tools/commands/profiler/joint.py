"""weldcal profiler planes and joint: the pose on the flange from planes, or from edge, sphere and planes together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer
from numpy.typing import NDArray

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.profiler.combined.planes import line_of, plane_scans, planes_fit
from weldcal.calibration.profiler.combined.scans import FeatureScans
from weldcal.calibration.profiler.combined.solve import JointEstimate, solve_joint
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.edge import (
    SIGMAS_MM,
    break_figures,
    edge_by_noise,
    edge_part,
    edge_shown,
    straightened,
)
from weldcal.tools.commands.profiler.files import Measurements
from weldcal.tools.commands.profiler.result import (
    PosesOption,
    RadiusOption,
    Sigmas,
    UnitOption,
    check_number,
    figures_of,
    finish,
    outcome_of,
    read_measurements,
    stated_correction,
    with_warnings,
)
from weldcal.tools.commands.profiler.sphere import decided_sphere, sphere_part
from weldcal.tools.report.first_screen import check_limit
from weldcal.tools.report.profiler_file import DISAGREE

KINDS = ("edge", "sphere", "planes")
MOST_PLANES = 3
ARM_LARGE_M = 0.3e-3  # a choice: what arms that are not calibrated are wrong by
_AFFINE = SphereSigmas().affine


@dataclass(frozen=True, eq=False)
class PlanesShown:
    """Poses, profiles (m, 2) m and the plane (n,) of the profiles that show a line; ``lost``: numbers of the others."""

    poses: FlangePoses
    profiles: tuple[Floats, ...]
    of: NDArray[np.intp]
    lost: list[int]


def planes_shown(files: Sequence[Measurements]) -> PlanesShown:
    """Return the profiles of planes; a file is of one plane, or its array ``plane`` numbers them.

    Raises:
        InputError: no profiles, or more than three planes.
    """
    R, t, of = list[Floats](), list[Floats](), list[tuple[int, float]]()
    profiles, lost = list[Floats](), list[int]()
    for n, file in enumerate(files):
        if file.profiles is None:
            raise InputError("The file has no 'profiles' of a plane. Give (n, m, 2), or 'xz' with the lengths 'n'.")
        poses = cast(FlangePoses, file.poses())
        check_number(poses, (len(file.profiles),), "profiles")
        plane = file.arrays.get("plane", np.zeros(len(poses)))
        check_number(poses, plane.shape, "numbers 'plane'")
        for k, p in enumerate(file.profiles):
            try:
                line_of(p)
            except FeatureNotFound:
                lost.append(len(lost) + len(profiles))
                continue
            R.append(poses.rotation[k])
            t.append(poses.translation[k])
            profiles.append(p)
            of.append((n, float(plane[k])))
    if not profiles:
        raise FeatureNotFound("No profile shows a single line: bring the plane alone into the laser line.")
    known = sorted(set(of))
    if len(known) > MOST_PLANES:
        raise InputError(f"{len(known)} planes are more than {MOST_PLANES}: give the profiles of up to {MOST_PLANES}.")
    return PlanesShown(
        FlangePoses(np.array(R), np.array(t)), tuple(profiles), np.array([known.index(one) for one in of]), lost
    )


def planes_decided(files: Sequence[Measurements], form: str = "") -> list[Measurements]:
    """Return files of planes with the reading of the poses that a form, or else the first file's planes, select."""
    first, *rest = [file.with_form(form) for file in files]
    if len(first.readings) > 1:
        shown = planes_shown([first.read_as(0)])
        kept = np.setdiff1d(np.arange(len(first.readings[0].X)), shown.lost)
        fit = planes_fit(shown.profiles, shown.of)
        first = first.decided(lambda poses: fit(poses[kept]), "set of planes")
    if first.readings:
        rest = [file.with_form(first.readings[0].form) for file in rest]
    if any(len(file.readings) > 1 for file in rest):
        raise InputError("The files' poses are in several forms: state it with --as robot-form=FORM.")
    return [first, *rest]


@command(
    "profiler planes",
    keys=("robot-form", "set", "trial", "pitch", "sensor-correction"),
    short_help="Calibrate by one to three planes.",
)
def planes(
    call: Call,
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Profiles of a plane; a file for each plane.")],
    unit: UnitOption = None,
    poses: PosesOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by raw profiles of one to three planes, which may lie anywhere."""
    return _joined(call, [("planes", file) for file in files], unit, poses, limit_mm=limit_mm)


@command(
    "profiler joint",
    keys=("robot-form", "set", "trial", "pitch", "side", "z", "sensor-correction", *SIGMAS_MM),
    short_help="Calibrate by edge, sphere and planes together.",
)
def joint(
    call: Call,
    parts: Annotated[
        list[str],
        typer.Argument(metavar="KIND:FILE...", help="edge:FILE, sphere:FILE and planes:FILE of one mounting."),
    ],
    unit: UnitOption = None,
    feature: Annotated[str, option("--feature", "KIND", "For an edge's raw profiles: bar, step or apex.")] = "",
    radius: RadiusOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Calibrate the profiler's pose on the flange by several features of one mounting, and test whether they agree."""
    given = [(kind, Path(file)) for kind, _, file in (part.partition(":") for part in parts)]
    for part, (kind, file) in zip(parts, given, strict=True):
        if kind not in KINDS or file == Path():
            raise InputError(f"'{part}' is no part: write edge:FILE, sphere:FILE or planes:FILE.")
        if kind != "planes" and sum(kind == k for k, _ in given) > 1:
            raise InputError(f"{kind}:FILE is given twice: give it once, or calibrate by each and compare the results.")
    return _joined(call, given, unit, None, feature=feature, radius=radius, limit_mm=limit_mm)


def _joined(
    call: Call,
    given: Sequence[tuple[str, Path]],
    unit: str | None,
    poses: Path | None,
    *,
    feature: str = "",
    radius: float | None = None,
    limit_mm: float | None,
) -> Outcome:
    """Read the files of the parts, solve for one mounting, and write it."""
    check_limit(limit_mm)
    r, x, z = (1e-3 * call.reading.get(key, usual) for key, usual in SIGMAS_MM.items())
    sigmas = Sigmas(r, x, z, stated=any(key in call.reading for key in SIGMAS_MM))
    read: dict[str, list[Measurements]] = {kind: [] for kind in KINDS}
    for kind, path in given:
        try:
            read[kind].append(read_measurements(call, path, unit, poses, alone=len(given) == 1))
        except InputError as problem:
            if len(given) == 1:
                raise
            raise InputError(f"{kind}:{path.name}: {problem}") from problem
    lost: list[int] = []
    shown, sphere, data = None, None, [*read["planes"]]
    if read["edge"]:
        side = call.reading.get("side", "left")
        shown = edge_shown(read["edge"][0], sigmas, feature, side, call.reading.get("z", ""))
        data = [shown.file, *data]
    if read["sphere"]:
        radius_m = None if radius is None else 1e-3 * radius
        file, sphere = decided_sphere(read["sphere"][0], radius_m=radius_m, lost=lost, seed=call.seed)
        data = [file, *data]
    flat = None
    if read["planes"]:
        form = data[0].readings[0].form if len(data[0].readings) == 1 else ""
        flat = planes_shown(planes_decided(read["planes"], form))
    seen = [p for some in (sphere and sphere.profiles, flat and flat.profiles) if some for p in some]
    seen += [] if shown is None else [shown.points[shown.keep]]
    whole = np.vstack([p[np.isfinite(p).all(axis=1)] for p in seen])
    correction = stated_correction(call, seen)
    origin = whole.mean(axis=0) if correction is None else correction.origin
    affine, S = np.zeros(3), _AFFINE**2 * np.eye(3)
    if correction is not None:
        affine, S = correction.values, correction.covariance
    made: list[FeatureScans] = []
    if shown is not None:
        made.append(edge_part(shown, *(shown.fit or edge_by_noise(*shown.seen(), sigmas)), origin, affine))
    if sphere is not None:
        right = [straightened(p, affine, origin) for p in sphere.profiles]
        sphere = replace(sphere, touches=None, tip=None, touch_q=None, profiles=right)
        ball = sphere_joint(sphere, "affine", SphereSigmas(sensor_m=z, robot_m=r))
        made.append(sphere_part(sphere, ball, origin))
    if flat is not None:
        level = [straightened(p, affine, origin) for p in flat.profiles]
        made.append(plane_scans(flat.poses, level, flat.of, origin, made[-1].X_FS if made else None))
    e = solve_joint(made, S)
    found = joint_figures(e, made) | {
        "without_feature": [] if shown is None else shown.lost,
        "without_sphere": lost,
        "without_plane": [] if flat is None else flat.lost,
    }
    found["scans"] += sum(len(found[key]) for key in ("without_feature", "without_sphere", "without_plane"))
    digests = [one.digest for one in data]
    if len(set(digests)) < len(digests):
        raise InputError("Two of the files are the same: give each file once.")
    record = ProfilerRecord.of("+".join(part.name for part in made) + ", joint", e, found, "+".join(digests))
    record = replace(record, affine=affine + e.sensor, origin=origin)
    name = "+".join(file.name for _, file in given)
    folder = call.folder("profiler", given[0][1].stem if len(given) == 1 else "joint")
    result, summary = finish(record, with_warnings(data[0], found), whole, np.zeros(0), name, folder, limit_mm)
    return outcome_of(call, summary, result)


def joint_figures(e: JointEstimate, parts: Sequence[FeatureScans]) -> dict[str, Any]:
    """Result of a joint solution for the JSON object, with the advice of its test of agreement."""
    found: dict[str, Any] = {"scans": sum(len(part.poses) for part in parts), **figures_of(e)}
    found["parts"] = {part.name: len(part.poses) for part in parts}
    found["odd_scans"] = {part.name: list(odd) for part, odd in zip(parts, e.odd, strict=True)}
    found |= break_figures(e)
    said = []
    if e.tested:
        found["agree"] = not e.causes
        found["causes"] = [cause.words for cause in e.causes]
    if e.causes:
        first, *other = e.causes
        said.append(f"{DISAGREE}: {first.words}: {first.advice}.")
        said += [f"As likely an explanation: {one.words}: {one.advice}." for one in other]
    if e.arm_m > ARM_LARGE_M:
        said.append(
            f"The arm's error changes by {1e3 * e.arm_m:.2f} mm between these poses, more than calibrated arms have:"
            " check the payload and the TCP, or have the arm's kinematics calibrated."
        )
    return found | {"warnings": said}
