"""weldcal hand-eye: solves for the unknown poses from a file of pose pairs, compares all methods and writes exports."""

import time
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.data.poses.lists import folder_lists, two_lists
from weldcal.calibration.data.poses.names import mounting_name
from weldcal.calibration.errors import InconsistentPoses, UndeterminedPoses
from weldcal.calibration.geometry.se3 import IDENTITY, inverse
from weldcal.calibration.hand_eye.corners import CornerRefinement, poses_from_corners, refine_with_corners
from weldcal.calibration.hand_eye.determinacy import check_poses
from weldcal.calibration.hand_eye.exports import Provenance, export_hand_eye
from weldcal.calibration.hand_eye.joints import poses_of_arm, refine_joints
from weldcal.calibration.hand_eye.mistakes import explain_outliers, likely_mistake, with_scale
from weldcal.calibration.hand_eye.mountings import get_mounting
from weldcal.calibration.hand_eye.opencv_methods import METHODS, most_compared, opencv_held_out
from weldcal.calibration.hand_eye.pairs.files import PosePairs, read_pairs
from weldcal.calibration.hand_eye.pairs.importing import FARTHEST_M, StatedForms, import_pairs
from weldcal.calibration.hand_eye.pictures.boards import FORMS, parse_board
from weldcal.calibration.hand_eye.pictures.sets import PictureSet, read_pictures
from weldcal.calibration.hand_eye.pictures.solution import PictureResult, solve_pictures
from weldcal.calibration.hand_eye.problem import Problem, full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_ax_xb, solve_problem
from weldcal.calibration.motion.pose_streams import ClockOffset, are_trajectories, is_stream_file, synchronise_lists
from weldcal.calibration.planning.next_pose import VisibleVolume, next_pose, view_of
from weldcal.models.arms.chain import Chain, load_chain
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option, switch
from weldcal.tools.report.first_screen import check_limit, typed
from weldcal.tools.report.hand_eye import HandEyeReport, MethodRow, hand_eye_report
from weldcal.tools.report.render import write_atomic

EQUATIONS = ("ax-xb", "ax-yb", "axb-ycz")

FileArgument = Annotated[
    Path,
    typer.Argument(
        help="A file or folder with the robot's and the camera's poses (docs/datasets.md), or two pose streams.",
        show_default=False,
    ),
]
MountingOption = Annotated[
    str | None, option("--mounting", "NAME", "eye_in_hand, eye_on_base ..., if the file does not name it.")
]
UnitOption = Annotated[
    str | None,
    option(
        "--unit",
        "UNIT",
        "Unit of all positions: m, mm, cm or inch; inch,mm for robot and camera.",
        show_default="by the robot's reach and the motions",
    ),
]
RobotPosesOption = Annotated[
    str | None, option("--robot-poses", "NAME", "The file, folder, array or label that holds the robot's poses.")
]
CameraPosesOption = Annotated[
    str | None, option("--camera-poses", "NAME", "The file, folder, array or label that holds the camera's poses.")
]
_FORM = "such as euler_xyz,deg, quaternion_wxyz or matrix,inverse. Without it the data choose."
RobotFormOption = Annotated[str | None, option("--robot-form", "FORM", f"How the robot's poses are written, {_FORM}")]
CameraFormOption = Annotated[
    str | None, option("--camera-form", "FORM", f"How the camera's poses are written, {_FORM}")
]
RobotOption = Annotated[
    str | None,
    option("--robot", "NAME", "The arm, for example ur10e or my_arm.urdf: the next pose is then within its reach."),
]
JointsOfOption = Annotated[
    str | None, option("--robot", "NAME", "The arm (ur10e, my_arm.urdf), where joint angles stand for its poses.")
]
ScannerOption = Annotated[
    str | None, option("--camera", "NAME", "The scanner, for example phoxi_s: the next pose is then in its view.")
]
BoardOption = Annotated[
    str | None,
    option(
        "--board",
        "BOARD",
        f"Calibrate from pictures of this board, lengths in mm: {', '.join(FORMS.values())}. COLSxROWS of a chessboard"
        " are inner corners.",
    ),
]
IntrinsicsOption = Annotated[
    Path | None,
    option(
        "--intrinsics",
        "FILE",
        "With --board: the file that states the camera (ROS, OpenCV, Kalibr).",
        show_default="a camera file in the folder, else estimated",
    ),
]


@command("hand-eye ax-xb", short_help="Solve AX = XB for the camera's pose.")
def ax_xb(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot: JointsOfOption = None,
    motions: Annotated[bool, switch("--motions", "The file holds motions (A and B of A X = X B), not poses.")] = False,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    robot_form: RobotFormOption = None,
    camera_form: CameraFormOption = None,
    board: BoardOption = None,
    intrinsics: IntrinsicsOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = XB for the camera's pose. With poses, the target's pose is estimated too, so that each counts once."""
    return _solve("ax-xb", **locals())


@command("hand-eye ax-yb", short_help="Solve AX = YB for the poses of camera and target.")
def ax_yb(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    corners: Annotated[
        bool | None,
        switch(
            "--corners/--no-corners",
            "Use the board's corners: minimise the reprojection error, and test for a shifted principal point.",
            show_default="if the file holds them",
        ),
    ] = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    refine: Annotated[
        str | None,
        option("--refine", "KIND", "joints or links: estimate errors of the robot (needs --robot and joint angles q)."),
    ] = None,
    kinematics: Annotated[
        Path | None,
        option("--kinematics", "FILE", "With --robot: the arm's own kinematics, such as calibrate --refine writes."),
    ] = None,
    robot_poses: RobotPosesOption = None,
    camera_poses: CameraPosesOption = None,
    robot_form: RobotFormOption = None,
    camera_form: CameraFormOption = None,
    board: BoardOption = None,
    intrinsics: IntrinsicsOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AX = YB for the poses of camera and target together, and propose the next pose to add."""
    return _solve("ax-yb", **locals())


def stated_forms(
    robot_poses: str | None, camera_poses: str | None, robot_form: str | None, camera_form: str | None
) -> StatedForms:
    """What the options state of the two lists of poses."""
    forms = [PoseForm() if form is None else PoseForm(rotation=form) for form in (robot_form, camera_form)]
    return StatedForms(robot=forms[0], camera=forms[1], robot_poses=robot_poses, camera_poses=camera_poses)


@command("hand-eye axb-ycz", short_help="Solve AXB = YCZ for two robots.")
def axb_ycz(
    call: Call,
    file: FileArgument,
    mounting: MountingOption = None,
    unit: UnitOption = None,
    robot: RobotOption = None,
    camera: ScannerOption = None,
    limit_mm: LimitOption = None,
) -> Outcome:
    """Solve AXB = YCZ for camera, second base and target: one robot carries the camera, another the target."""
    return _solve("axb-ycz", **locals())


def _solve(
    equation: str,
    call: Call,
    file: Path,
    robot_poses: str | None = None,
    camera_poses: str | None = None,
    robot_form: str | None = None,
    camera_form: str | None = None,
    **options: Any,
) -> Outcome:
    """Solve with the options of a command, as they were given."""

    said: list[str] = []
    folder = call.folder("hand-eye", file.resolve().stem)
    stated = stated_forms(robot_poses, camera_poses, robot_form, camera_form)
    try:
        report = run_hand_eye(equation, file, folder, seed=call.seed, stated=stated, say=said.append, **options)
    except WeldcalError:
        for sentence in said if not call.json else ():  # how the file was read is part of what a refusal says
            typer.echo(sentence)
        raise
    return Outcome(report.summary(), text="\n".join([*said, report.text()]), first=report.first)


def run_hand_eye(
    equation: str,
    file: Path,
    out: Path,
    *,
    mounting: str | None = None,
    unit: str | None = None,
    motions: bool = False,
    corners: bool | None = False,
    robot: str | None = None,
    camera: str | None = None,
    refine: str | None = None,
    kinematics: Path | None = None,
    seed: int = 0,
    limit_mm: float | None = None,
    stated: StatedForms | None = None,
    board: str | None = None,
    intrinsics: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> HandEyeReport:
    """Calibrate from a file; ``say`` gets the pose-diversity report before anything is solved.

    Writes report.html besides the exports.

    ``corners``: use those of the file (None: where it holds some). ``robot``, ``camera``: names of the arm and the
    scanner, for the next pose. ``refine``: "joints" or "links", errors of that robot to look for (one of corners and
    robot errors is applied: the robot's errors are sought in the poses that the corners left). ``kinematics``: file of
    that robot's own kinematics, whose poses at the joint angles replace the stated ones. ``limit_mm`` is the held-out
    error at the target, 95 %, that the job allows. ``board``: the board in the pictures of the folder ``file``, see
    ``parse_board``; ``intrinsics``: the file that states their camera.

    Raises:
        InputError, WeldcalError: the file or the options cannot be used. Where the poses contradict each other, the
            sentence names the mistake (unit, inverse, mounting) whose correction makes them agree, if there is one.
    """
    begin = time.perf_counter()
    check_limit(limit_mm)
    if equation not in EQUATIONS:
        raise InputError(f"There is no equation '{equation}'. Choose one of {', '.join(EQUATIONS)}.")
    if kinematics is not None and robot is None:
        raise InputError("A kinematics file (--kinematics) needs the robot's name. Add --robot, for example ur10e.")
    arm = None if robot is None else load_chain(robot, kinematics)
    if board is not None and camera is not None and Path(camera).is_file():
        intrinsics, camera = Path(camera), None
    if board is None and intrinsics is not None:
        raise InputError("A camera file (--intrinsics) goes with pictures: name the board in them with --board.")
    if board is not None and (motions or corners is False or refine is not None or equation == "axb-ycz"):
        raise InputError("Pictures (--board) are solved by their corners: omit --motions, --no-corners and --refine.")
    scanner = None if camera is None else get_scanner(camera)
    if refine is not None and arm is None:
        raise InputError("Robot errors (--refine) need the robot's name. Add --robot, for example ur10e.")
    streams, shots = None, None
    stated = replace(stated or StatedForms(), arm=robot)
    if board is not None:
        shots = read_pictures(file, parse_board(board), mounting=mounting, unit=unit, stated=stated, camera=intrinsics)
    elif is_stream_file(file):
        if unit not in (None, "m") or motions:
            raise InputError("Two streams of poses are in metres; omit --unit and --motions.")
        from weldcal.calibration.motion.pose_streams import read_streams, synchronise

        streams = synchronise(read_streams(file), mounting=mounting or "eye_in_hand", source=file.name)
        say(streams.sentence)
    if shots is not None:
        pairs = shots.pairs
    else:
        stated = replace(stated, decide=not motions)
        if streams is None and not motions:
            streams = _trajectories(file, mounting, stated)
            if streams is not None:
                say(streams.sentence)
        pairs = read_pairs(file, mounting=mounting, length=unit, stated=stated) if streams is None else streams.pairs
    for sentence in understood(pairs):
        say(sentence)
    found = get_mounting(pairs.mode)
    if kinematics is not None and arm is not None:
        pairs = poses_of_arm(pairs, arm)
    if (equation == "axb-ycz") != (found.name == "co_manipulation"):
        right = "axb-ycz" if found.name == "co_manipulation" else "ax-yb"
        raise InputError(f"'{file.name}' is {found.name}. Solve it with '{typed(f'hand-eye {right}', file)}'.")
    config = HandEyeConfig(seed=seed)
    pictures: PictureResult | None = None
    if motions:
        if equation != "ax-xb":
            raise InputError("Motions (--motions) belong to ax-xb.")
        result = solve_ax_xb(pairs.robot, pairs.camera, config)
        problem = full_problem(pairs.robot, inverse(pairs.camera), free=(True, False, False), tied=True)
        result = with_scale(problem, result, config)
    else:
        problem = problem_of_pairs(pairs)
        say(check_poses(problem).sentence())
        if shots is None:
            result = solve_pairs(pairs, config)
        else:
            result, pairs, pictures = _solved_pictures(shots, config)
            problem = problem_of_pairs(pairs)
    said: list[str] = [] if pictures is None else pictures.sentences
    adopted = False
    optional = corners is None
    if pictures is not None:
        corners = False
    elif corners is None:
        corners = pairs.has_corners and not motions and found.name in ("eye_in_hand", "eye_on_base")
    if corners:
        if motions or found.name == "co_manipulation":
            raise InputError("Corners (--corners) go with the poses of one robot.")
        refined = _refined(pairs, config, said, optional=optional)
        if refined is not None and refined.accepted:
            adopted = True
            of_poses: dict[str, Any] = {"warnings": result.warnings, "scale": result.scale}
            result = replace(refined.result, labels=found.labels, equation=found.equation, **of_poses)
            pairs = replace(pairs, camera=poses_from_corners(pairs, refined.shift_px))
            problem = problem_of_pairs(pairs)
    if refine is not None and arm is not None:
        robot_errors = refine_joints(pairs, result, arm, refine, config=config)
        said.append(robot_errors.sentence)
        result, adopted = robot_errors.result, adopted or robot_errors.accepted
    if equation == "ax-xb":
        result = _only_camera(result)
    # with corners or robot errors applied the poses are others, so that a comparison would be of two data
    comparison = () if motions or adopted else _compare(problem, result)
    advice, advised = None, ""
    if not motions and equation != "ax-xb":
        view = view_of(problem.G, pairs.K if pairs.has_corners else None, scanner)
        advice = next_pose(problem, result, found, (IDENTITY,) * 3, arm=arm, view=view)
        advised = advice.sentence() if advice is not None else _no_advice(view, arm)
    provenance = Provenance(file.name, digest(file))
    files = export_hand_eye(result, found, out, provenance)
    seconds = time.perf_counter() - begin
    report = HandEyeReport(
        result=result,
        mounting=found,
        comparison=comparison,
        next_pose=advice,
        files=files,
        seconds=seconds,
        corners=" ".join(said),
        advice=advised,
        reading=pairs.reading,
        read_notes=pairs.notes,
        streams=streams,
        limit_mm=limit_mm,
        folder=out,
        pictures=pictures,
    )
    write_atomic(out / "report.html", hand_eye_report(report, file.name, provenance.sha256))
    return report


def _trajectories(path: Path, mounting: str | None, stated: StatedForms) -> ClockOffset | None:
    """Return the pairs of two recordings in motion of a folder; None where it holds none."""
    if not path.is_dir() or (path / "pairs.npz").exists():
        return None
    try:
        lists = two_lists(folder_lists(path), path.name, stated.robot_poses, stated.camera_poses)
    except InputError:
        return None  # the reader of pairs says what is wrong
    if not are_trajectories(*lists):
        return None
    forms = (stated.robot, stated.camera)
    robot, camera = (
        one.of_arm(stated.arm).stated(form, f"--{who}-form")
        for one, form, who in zip(lists, forms, ("robot", "camera"), strict=True)
    )
    return synchronise_lists(robot, camera, mounting=mounting_name(mounting or "eye_in_hand"), source=path.name)


def _solved_pictures(shots: PictureSet, config: HandEyeConfig) -> tuple[HandEyeResult, PosePairs, PictureResult]:
    """Return the result of pictures, with the names of those that are not used."""
    result, pairs, pictures = solve_pictures(shots, lambda pairs: solve_pairs(pairs, config))
    left = [f"{p.name} ({p.why[0].lower()}{p.why[1:].rstrip('.')})" for p in pictures.pictures if p.why]
    warnings = [w for w in result.warnings if "were excluded:" not in w]
    if left:
        warnings.insert(0, f"{len(left)} of {len(pictures.pictures)} pictures are not used: {'; '.join(left)}.")
    return replace(result, warnings=tuple(warnings)), pairs, pictures


def _refined(pairs: PosePairs, config: HandEyeConfig, said: list[str], *, optional: bool) -> CornerRefinement | None:
    """The refinement by corners, with a sentence added to ``said``; None where ``optional`` corners cannot be used."""
    try:
        refined = refine_with_corners(pairs, config)
    except WeldcalError as problem:
        if not optional:
            raise
        said.append(f"Corners: not used. {problem}")
        return None
    said.append(refined.sentence)
    return refined


def _no_advice(view: VisibleVolume, arm: Chain | None) -> str:
    reach = "" if arm is None else f" and within reach of {arm.name}"
    return (
        f"No further pose near those so far is visible{reach} (view: {view.source}). Move to a region with a better"
        " view."
    )


def digest(path: Path) -> str:
    """SHA-256 of a file, or of the files of a folder in the order of their names."""
    if path.is_file():
        return sha256(path.read_bytes()).hexdigest()
    whole = sha256()
    for one in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(one.relative_to(path).as_posix().encode())
        whole.update(one.read_bytes())
    return whole.hexdigest()


def understood(pairs: PosePairs) -> list[str]:
    """How a file was understood, a line for each list, and the notes."""
    lines = []
    for who, found in pairs.reading.items():
        out = len(found["left_out"])  # type: ignore[arg-type]
        left = f", {out} left out" if out else ""
        lines.append(
            f"{who:<7}{found['file']}: {found['rows']} poses{left}, {found['form']}, read as {found['reading']} in"
            f" {found['unit']}"
        )
    return [*lines, *pairs.notes]


def _only_camera(result: HandEyeResult) -> HandEyeResult:
    return replace(
        result,
        poses={"X": result.poses["X"]},
        covariance={"X": result.covariance["X"]},
        joint_covariance=result.covariance["X"],
    )


def solve_pairs(pairs: PosePairs, config: HandEyeConfig | None = None) -> HandEyeResult:
    """Return the poses of a file's mounting, with a test for the usual mistakes in files.

    Raises:
        InconsistentPoses: the correction of one mistake makes the poses agree far better; others as solve_problem.
    """
    config, mounting = config or HandEyeConfig(), get_mounting(pairs.mode)
    problem = problem_of_pairs(pairs)
    try:
        result = solve_problem(problem, config=config, equation=mounting.equation, labels=mounting.labels)
    except (InconsistentPoses, UndeterminedPoses) as e:
        mistake = likely_mistake(pairs)
        if mistake is None:
            raise
        raise InconsistentPoses(mistake) from e
    mistake = likely_mistake(pairs)
    if mistake is not None:
        raise InconsistentPoses(mistake)
    explained = replace(result, warnings=(*result.warnings, *explain_outliers(pairs, result)))
    return with_scale(problem, explained, config)


def solve_arrays(
    robot: Array, camera: Array, mounting: str, robot_form: str | None = None, camera_form: str | None = None
) -> HandEyeResult:
    """Solve pairs of poses (n, 4, 4) in metres; the data choose how the matrices are read, as for a file.

    Raises:
        InputError: as read_pairs and solve_pairs.
    """
    far = float(np.median(np.linalg.norm(robot[:, :3, 3], axis=1)))
    if far > FARTHEST_M:
        raise InputError(
            f"The robot's positions have a median of {far:.4g} from the base: they must be metres. Divide millimetres"
            " by 1000."
        )
    stated = replace(stated_forms(None, None, robot_form, camera_form), unit="m")
    lists = [listing_of_array(name, X) for name, X in (("robot", robot), ("camera", camera))]
    found = import_pairs(lists, "the poses", mounting, stated)
    usual = len(found.robot) == len(robot) and all(one["reading"] == "matrix" for one in found.reading.values())
    if not usual:
        robot, camera = found.robot, found.camera
    result = solve_pairs(PosePairs(source="the poses", robot=robot, camera=camera, mode=mounting))
    return replace(result, warnings=(*found.notes, *result.warnings))


def problem_of_pairs(pairs: PosePairs) -> Problem:
    """Return the equation of a file's mounting."""
    return full_problem(pairs.F, pairs.G, pairs.H, free=(True, True, pairs.mode == "co_manipulation"))


def _compare(problem: Problem, ours: HandEyeResult) -> tuple[MethodRow, ...]:
    rows = [MethodRow("weldcal", ours.held_out.rms_deg, 1e3 * ours.held_out.rms_translation)]
    if problem.free == (True, True, False):
        for m in METHODS:
            held = opencv_held_out(
                m, problem.F, problem.G, most=most_compared(len(problem.F)), observation=ours.observation
            )
            whole = bool(np.isfinite(held.translation).all())
            errors = (held.rms_deg, 1e3 * held.rms_translation) if whole else (float("nan"), float("nan"))
            rows.append(MethodRow(m, *errors))
    return tuple(rows)
