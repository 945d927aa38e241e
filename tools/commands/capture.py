"""weldcal capture: scans or pictures at a robot that is jogged by hand; a page judges each at once."""

from __future__ import annotations

import webbrowser
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from weldcal.calibration.capture.carried import CarriedTask
from weldcal.calibration.capture.session import CaptureSession, CaptureTask
from weldcal.calibration.capture.tasks import BoardTask, FlangeTask
from weldcal.calibration.data.results import ON_BASE
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.errors import InputError
from weldcal.models.robots import get_robot
from weldcal.systems.drivers.arm_poses import KINDS, ArmSource, arm_source
from weldcal.tools import console
from weldcal.tools.cli.options import LOOK, Call, command, option, switch
from weldcal.tools.cli.result_folder import claimed
from weldcal.tools.commands.profiler.captured import ProfileTask
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell
from weldcal.tools.dashboard.capture_run import CaptureRun, DriverSensor, FolderSensor, Sensor
from weldcal.tools.dashboard.capture_run import webcam as opened_webcam

PERIOD_S = 0.5


@command(
    "capture",
    keys=("intrinsics",),
    options=("browser", "seed"),
    common=LOOK,
    short_help="Capture by hand: each scan or picture is judged at once.",
)
def capture(
    call: Call,
    scenario: Annotated[
        str | None, typer.Argument(metavar="[SCENARIO]", help="A scenario whose scanner takes the scans.")
    ] = None,
    poses: Annotated[str, option("--poses", "SOURCE", f"Where the arm's pose is read: {KINDS}; without: typed.")] = "",
    watch: Annotated[
        Path | None, option("--watch", "FOLDER", "The folder into which the sensor's own program writes.")
    ] = None,
    webcam: Annotated[str | None, option("--webcam", "N", "Number or URL of a camera.")] = None,
    board: Annotated[
        str | None, option("--board", "BOARD", "Pictures of this board, as hand-eye --board, in place of the flange.")
    ] = None,
    mounting: Annotated[
        str, option("--mounting", "NAME", "Of the camera: eye_in_hand (on the flange) or eye_on_base.")
    ] = "",
    profiler: Annotated[
        str,
        option(
            "--profiler",
            "TARGET",
            "Of a laser profiler on the flange: edge:bar, edge:step, edge:apex, sphere:RADIUS_MM.",
        ),
    ] = "",
    robot: Annotated[str, option("--robot", "NAME", "The arm, such as ur10e.")] = "",
    flange: Annotated[str, option("--flange", "NAME", "The flange, where the arm's own does not say.")] = "",
    required_mm: Annotated[
        float | None,
        option(
            "--required-mm", "MM", "The error at the work point that is wanted: of the scenario, or 0.2.", min=0.001
        ),
    ] = None,
    demo: Annotated[
        bool, switch("--demo", "With an emulated arm and scanner; the page's buttons jog the arm.")
    ] = False,
    out: Annotated[Path, option("--out", "FOLDER", "Of the session; one that is there goes on.")] = Path("capture"),
) -> dict[str, object]:
    """Take scans of the flange, or pictures of a board, by hand; the page judges each and proposes the next pose.

    Nothing is sent to the robot. All captures are in `captures` of --out, which `weldcal calibrate` or
    `weldcal hand-eye` reads; a session that is there goes on. Ctrl+C ends it.
    """
    if mounting not in ("", "eye_in_hand", "eye_on_base"):
        raise InputError(f"--mounting must be eye_in_hand (on the flange) or eye_on_base, not '{mounting}'.")
    if mounting and not board:
        raise InputError("--mounting is that of a camera: give --board with it. A scanner's is in the scenario.")
    if demo and (watch or webcam or poses or board or profiler):
        raise InputError(
            "--demo brings its own arm and scanner: leave out the sensor, --poses, --board and --profiler."
        )
    if out.is_dir() and any(out.iterdir()) and not (out / "captures").is_dir():
        raise InputError(f"'{out}' holds other files: name another folder with --out.")
    carried, wanted_mm = (None, 0.2) if scenario is None else _carried(scenario, call.seed)
    if demo and scenario and carried is None:
        raise InputError(
            f"The scanner of '{scenario}' is not on the arm: leave the scenario out for a scanner beside the arm, or"
            " take eye_in_hand or eye_on_arm."
        )
    cell = DemoCell(call.seed, None if carried is None else carried.scene) if demo else None
    robot = ROBOT if demo else robot
    task: CaptureTask
    if board:
        task = BoardTask(board, mounting or "eye_in_hand", robot, call.reading.get("intrinsics"))
    elif profiler:
        task = ProfileTask(profiler, robot)
    else:
        task = carried or FlangeTask(robot, flange or _flange_of(robot))
    sensor = cell or _sensor(scenario, watch, webcam)
    arm: ArmSource = cell or arm_source(poses)
    run = CaptureRun(CaptureSession(out / "captures", task), arm, sensor, required_mm or wanted_mm, "weldcal capture")
    with claimed(out, overwrite=True), closing(run):
        _serve(run, call.live["browser"], robot if carried is None else carried.scene.arm.name)
    return {
        "state": "done",
        "folder": str(out),
        "captures": len(run.session.captures),
        "next": task.command(run.session.folder) if run.session.captures else "nothing was captured",
    }


def _serve(run: CaptureRun, browser: bool, robot: str) -> None:
    """Serve the page until Ctrl+C."""
    from weldcal.tools.dashboard.capture_view import CaptureView
    from weldcal.tools.dashboard.server import Dashboard  # Flask takes a moment to load

    view = CaptureView(load_arm(robot) if robot in known_arms() else None)
    with closing(Dashboard(run, view.url, page="capture")) as page:
        console.emit_address("capture", page.url)
        if browser:
            webbrowser.open(page.url)
        try:
            while True:
                if run.changed.wait(PERIOD_S):
                    run.changed.clear()
                    view.show(run)
        except KeyboardInterrupt:
            return


def _carried(scenario: str, seed: int) -> tuple[CarriedTask | None, float]:
    """Return the task of a scenario whose scanner is on the arm (None: beside it), and the wanted error, mm."""
    from weldcal.systems.jobs.mounting.job import mounting_plan, mounting_scene
    from weldcal.systems.scenario.loading import load_scenario

    loaded = load_scenario(scenario)
    if loaded.calibration.configuration == ON_BASE:
        return None, loaded.calibration.required_error_mm
    header, scene, circle = mounting_scene(loaded, load_arm(loaded.arm))
    return CarriedTask(header, scene, circle, mounting_plan(loaded, seed)), loaded.calibration.required_error_mm


def _flange_of(robot: str) -> str:
    if not robot:
        raise InputError("Name the arm with --robot, such as ur10e, or its flange with --flange.")
    return get_robot(robot).flange


def _sensor(scenario: str | None, watch: Path | None, webcam: str | None) -> Sensor:
    """Return what takes the scans or pictures. Raises InputError where none, or several, are named."""
    if sum(one is not None for one in (scenario if watch is None else None, watch, webcam)) != 1:
        raise InputError(
            "Name one sensor: --watch FOLDER, into which its own program writes; --webcam N; a scenario with its"
            " driver; or --demo."
        )
    if watch is not None:
        return FolderSensor(watch)
    if webcam is not None:
        return opened_webcam(webcam)
    assert scenario is not None
    from weldcal.systems.scenario.loading import load_scenario

    config: Any = load_scenario(scenario).scanner_config()
    if not hasattr(config, "source"):
        raise InputError(
            f"The scanner of '{scenario}' is simulated, or has no driver: name another scenario, or --demo."
        )
    return DriverSensor(config.source(), type(config).__name__)
