"""weldcal replay and view: repeat a recorded run bit for bit, and show the pages of a finished one, or a scan."""

import json
import tempfile
import webbrowser
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.errors import InputError
from weldcal.models.files import UNFINISHED, require_whole, write_atomic
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.station_build import PreparedRobot
from weldcal.systems.recording.player import Playback
from weldcal.systems.recording.port_recorder import LEFT, PERIOD_S
from weldcal.systems.recording.reader import Comparison, Difference, read_recording
from weldcal.systems.recording.scenario_files import unpacked
from weldcal.systems.recording.values import array, decode
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools import console
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, option, switch
from weldcal.tools.cli.result_folder import RECORDING
from weldcal.tools.commands.run import one_thread
from weldcal.tools.commands.weld import killed_weld
from weldcal.tools.report.first_screen import pose_rows
from weldcal.tools.report.weld_record import RECORD_HTML

IDENTICAL, DIFFERS = "identical", "differs"


@command("replay", common=LOOK, short_help="Repeat a recorded run and compare bit for bit.")
def replay(
    call: Call,
    recording: Annotated[Path, typer.Argument(help="A recording.mcap from --record, or the folder that holds it.")],
) -> Outcome:
    """Run today's algorithms on what a recorded cell saw, and compare all that they did, bit for bit.

    The state is "identical", or "differs" with the first value that is another one; then the exit code is 1. A
    recording that was cut off is replayed to its end.
    """
    found = replay_recording(recording / RECORDING if recording.is_dir() else recording, call.progress)
    summary = found.summary()
    values = {
        "compared": f"{found.compared} messages of {found.seconds:.1f} s",
        "recorded with": f"weldcal {found.about.get('version')}, seed {found.about.get('seed')}",
        "ended in": found.phase,
    }
    if found.cut_off:
        values["note"] = "the recording was cut off before its run ended"
    first, problem = found.first, ""
    if first is not None:
        values["first difference"] = f"{first.name} at {first.time_s:.3f} s (message {first.message})"
        values["recorded, replayed"] = f"{first.was}, {first.now}"
        values["ports that differ"] = ", ".join(sorted(found.differences))
        problem = f"The replay differs from the recording since {first.time_s:.3f} s, first in {first.name}."
    rows = {} if found.X_BC is None else pose_rows(found.X_BC)
    return Outcome(summary, values=values, rows=rows, problem=problem)


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A finished replay: seconds replayed, number of values compared, and what differs by port.

    X_BC (4,4): the calibration that the replay has found, or None. cut_off: the file ends before its run.
    """

    seconds: float
    compared: int
    first: Difference | None
    differences: dict[str, Difference]
    about: dict[str, str]
    phase: str
    X_BC: list[list[float]] | None
    cut_off: bool

    def summary(self) -> dict[str, object]:
        """Return the JSON object."""
        found: dict[str, object] = {
            "state": IDENTICAL if self.first is None else DIFFERS,
            "seconds": self.seconds,
            "compared": self.compared,
            "cut_off": self.cut_off,
            "phase": self.phase,
            "X_BC": self.X_BC,
            "recorded_with": self.about.get("version"),
            "seed": int(self.about["seed"]),
        }
        if self.first is not None:
            found |= {
                "first": self.first.summary(),
                "differs": {name: d.summary() for name, d in sorted(self.differences.items())},
            }
        return found


def replay_recording(
    path: Path, progress: Progress = no_progress, look: Callable[[Cell[Any], Context], None] | None = None
) -> Replay:
    """Replay a recording; ``look`` is shown the cell and its Context at the end.

    Raises:
        InputError: it is no recording, of another format, or holds too little to replay.
    """
    progress("read the recording", 0.0)
    recording = read_recording(path)
    about = recording.about
    if not recording.entered or recording.end_tick < 1:
        raise InputError(f"'{path}' was cut off before the run began: there is nothing to replay.")
    sizes = json.loads(about["sizes"])
    comparison = Comparison(recording, sizes[LEFT])
    arm = decode(json.loads(about["arm"]), ArmModel)
    robot = PreparedRobot(arm, array(json.loads(about["q_start"])))
    played = Playback(recording.entered, json.loads(about["drives"]), recording.answers)
    # With more threads, sums are added in another order than in the run, and the last bits differ.
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        progress("build the cell", 0.02)
        scenario = unpacked(recording.files, Path(folder))
        cell = build_cell(scenario, int(about["seed"]), None, robot, played, lambda station, layout: comparison)
        with closing(cell.station):
            phase, X_BC = _run(cell, recording.end_tick * PERIOD_S, progress, look)
    comparison.finish()
    return Replay(
        seconds=recording.end_tick * PERIOD_S,
        compared=comparison.compared,
        first=comparison.first,
        differences=comparison.differences,
        about=about,
        phase=phase,
        X_BC=X_BC,
        cut_off=recording.end is None,
    )


def _run(
    cell: Cell[Any], end_s: float, progress: Progress, look: Callable[[Cell[Any], Context], None] | None
) -> tuple[str, list[list[float]] | None]:
    """Advance to the end of the recording; the phase there, and the calibration."""
    simulator = Simulator(cell.diagram)
    due = 0.0

    def watch(root: Context) -> EventStatus:
        nonlocal due
        if root.get_time() >= due:
            due = root.get_time() + 1.0
            progress(cell.job.command(root).phase.replace("_", " "), 0.05 + 0.94 * root.get_time() / max(end_s, 1e-9))
        return EventStatus.DidNothing()

    simulator.set_monitor(watch)
    simulator.Initialize()
    simulator.AdvanceTo(end_s)
    simulator.AdvancePendingEvents()
    simulator.clear_monitor()
    root = simulator.get_context()
    if look is not None:
        look(cell, root)
    status = getattr(cell.job, "calibration_status", None)
    estimate = None if status is None else status(root).estimate
    X_BC = None if estimate is None else estimate.X_BC.GetAsMatrix4().tolist()
    return str(cell.job.command(root).phase), X_BC


PAGES = ("report.html", RECORD_HTML, "recording.html", "seams.html", "tool.html")


@command(
    "view",
    common=("out", "overwrite", "json", "debug"),
    short_help="Show a finished run, or a scan over the robot's shape.",
)
def view(
    call: Call,
    result: Annotated[Path, typer.Argument(help="A result folder, or one recording.html or report.html.")],
    dataset: Annotated[
        Path | None, typer.Argument(help="Show a scan of this dataset over the robot, by distance.", show_default=False)
    ] = None,
    *,
    scan: Annotated[str | None, option("--scan", "ID", "The scan of the dataset.", show_default="the first")] = None,
    robot: Annotated[
        str | None, option("--robot", "NAME", "Robot of the dataset: a name, or a URDF file with its meshes.")
    ] = None,
    browser: Annotated[
        bool, switch("--browser/--no-browser", "Open the pages, or only print their paths.", show_default="browser")
    ] = True,
) -> Outcome:
    """Show a run again: its 3D recording and its report; of a broken weld also how to go on.

    With DATASET: a scan in the base by RESULT, each point coloured by its distance from the robot's surface.
    """
    if dataset is not None:
        pages, more, values = _scan_pages(call, result, dataset, scan, robot)
    elif scan or robot or call.out:
        raise InputError("--scan, --robot and --out are for a scan: give its dataset after the result.")
    else:
        pages, more, values = *_run_pages(result), None
    opened = browser and open_pages(pages)
    if browser and not opened:
        console.emit_warning("No web browser could be opened. Open these files on a machine that has one.")
    text = None if values else "\n".join(map(str, pages))
    return Outcome({"state": "done", "pages": pages, "opened": opened} | more, values=values, text=text)


def _run_pages(result: Path) -> tuple[list[Path], dict[str, object]]:
    """Return the pages of a finished run, and a note on a killed one."""
    note = killed_weld(result) if result.is_dir() else ""
    if note and not any((result / name).exists() for name in PAGES):
        raise InputError(note)
    killed = bool(note) and (result / UNFINISHED).exists()  # a report there is that of an earlier run
    pages = [(result / RECORD_HTML).resolve()] if killed else find_pages(result)
    if note:
        console.emit_warning(note)
    return pages, {"note": note} if note else {}


def _scan_pages(
    call: Call, result: Path, dataset: Path, scan: str | None, robot: str | None
) -> tuple[list[Path], dict[str, object], dict[str, object]]:
    """Write overlay.html and overlay.png of a scan; the page, and its distances for JSON and as rows."""
    # only here: another view needs none of these
    from weldcal.calibration.recorded_overlay import overlay
    from weldcal.tools.dashboard.scan_overlay import overlay_picture, scan_page

    call.progress("distances from the robot", 0.0)
    found = overlay(result, dataset, scan, robot)
    call.progress("picture and page", 0.7)
    out = call.folder("view", f"{dataset.resolve().name}-{found.scan}").resolve()
    write_atomic(out / "overlay.png", overlay_picture(found))
    write_atomic(out / "overlay.html", scan_page(found))
    if found.note:
        console.emit_warning(found.note)
    line = "{points} points; median {median_mm:.2f}, 95 % {p95_mm:.2f}, signed median {signed_mm:+.2f} mm"
    rows = {name: line.format(**row) for name, row in found.rows.items()}
    told = {"scan": found.scan, "points": len(found.body), "picture": out / "overlay.png"}
    page = out / "overlay.html"
    return [page], {**told, "bodies": found.rows, "note": found.note}, {**told, **rows, "page": page}


def find_pages(result: Path) -> list[Path]:
    """Return the absolute paths of the pages in a result folder (report first), or the one page that was given.

    Raises:
        InputError: if there is no such folder or file, or it holds no page.
    """
    if not result.exists():
        raise InputError(f"There is no {result}. Give the result folder of a weldcal command.")
    require_whole(result)
    candidates = [result] if result.is_file() else [result / name for name in PAGES]
    pages = [page.resolve() for page in candidates if page.is_file() and page.suffix == ".html"]
    if not pages:
        raise InputError(
            f"{result} holds neither report.html nor recording.html. Give the result folder of a finished run."
        )
    return pages


def open_pages(pages: list[Path]) -> bool:
    """Opens each page in the web browser; false where there is none."""
    opened = [webbrowser.open(page.as_uri()) for page in pages]
    return all(opened)
