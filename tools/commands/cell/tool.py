"""weldcal tool check: draws a tool; weldcal tool measure: measures it by scans, also of its own arm, and touches."""

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.header import DatasetHeader, PoseForm
from weldcal.calibration.data.results import load_result
from weldcal.calibration.data.writing import save_dataset
from weldcal.calibration.tool.comparison import (
    EXCEEDED,
    HOLDS,
    UNKNOWN,
    ToolVerdict,
    judge_tool,
    measured_file,
    tool_text,
    wire_sigma,
)
from weldcal.calibration.tool.measure import Move, NozzlePart, ToolMeasurement, find_ring, measure_tool, tool_scans
from weldcal.calibration.tool.wire import find_tcp, read_wire_touches
from weldcal.models.errors import InputError
from weldcal.models.files import sha256
from weldcal.models.tools.loading import check_sight, load_tool, tool_file
from weldcal.systems.jobs.tool_scan.planner import FEWEST, MOST, ToolScanConfig, check_tool_scan
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario, WeldingConfig
from weldcal.tools.cli.options import LIVE, Call, LimitOption, Outcome, command, option
from weldcal.tools.cli.result_folder import MEASURED_TOOL
from weldcal.tools.commands.run import run_job, run_options
from weldcal.tools.commands.touch import use_kinematics
from weldcal.tools.console import emit_summary
from weldcal.tools.report.first_screen import check_limit, typed
from weldcal.tools.report.page import Shot, TableRows, page_html
from weldcal.tools.report.profiler_file import left_out
from weldcal.tools.report.render import write_atomic, write_json
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.tool import TcpReport, ToolCheck, tool_picture, tool_report

TouchesOption = Annotated[
    Path | None, option("--touches", "FILE", "Flange poses at which the wire's end touched one point or a plate.")
]
CalibrationOption = Annotated[Path | None, option("--calibration", "RESULT", "Result of weldcal calibrate: X_BC.")]
SeamOption = Annotated[
    str | None, option("--scenario", "NAME", "Scenario with welding.tolerance_mm.", show_default="the usual tolerance")
]
CellOption = Annotated[
    str | None,
    option("--scenario", "NAME", "Without DATASET: the cell whose arm shows its tool. With it: welding.tolerance_mm."),
]
NozzleOption = Annotated[
    float, option("--nozzle-mm", "MM", "Length of the nozzle that is fitted, from its mouth.", min=15.0, max=300.0)
]
WireOption = Annotated[float, option("--wire-mm", "MM", "Diameter of the wire.", min=0.1, max=5.0)]
NOZZLE_MM, WIRE_MM = 50.0, 1.2  # a usual gas nozzle, and the wire of the shipped tool


@command("tool check", short_help="Check a tool file and draw the tool.")
def tool_check(
    call: Call,
    file: Annotated[Path, typer.Argument(help="A tool file; models/tools/welding.yaml is one.")],
    measure: Annotated[
        Path | None, option("--measure", "DATASET", "Scans of the tool: say what has moved against the tool file.")
    ] = None,
    calibration: CalibrationOption = None,
    touches: TouchesOption = None,
    scenario: SeamOption = None,
    nozzle_mm: NozzleOption = NOZZLE_MM,
    wire_mm: WireOption = WIRE_MM,
) -> Outcome:
    """Read a tool file, say what was understood of it, and draw it: tool.png and tool.html.

    With --measure, say what of the tool has moved, and whether the seam tolerance holds.
    """
    if measure is None:
        if calibration is not None or touches is not None or scenario is not None:
            raise InputError("--calibration, --touches and --scenario belong to --measure DATASET: name the scans.")
        folder = call.folder("tool", file.stem)
        loaded = load_tool(file)
        check = ToolCheck(loaded, check_sight(loaded), folder)
        picture = tool_picture(loaded)
        write_atomic(folder / "tool.png", picture)
        write_atomic(folder / "tool.html", tool_report(check, picture))
        rows = check.rows() if call.verbose else {key: check.rows()[key] for key in ("torch", "tip", "least pipe")}
        made, again = (
            typed(f"new {shlex.quote(file.stem + '_cell')} --tool-file", file),
            f"Correct {file}, then:\n{typed('tool check', file)}",
        )
        last = {"next": again if check.contradictions else made, "page": f"{folder / 'tool.html'} (-v prints all here)"}
        told = {f"note {k + 1}": text for k, text in enumerate(check.contradictions)} | rows | last
        return Outcome(check.summary(), text=partial(emit_summary, f"tool check: {check.verdict}", told))
    if calibration is None:
        raise InputError("--measure needs --calibration RESULT: the folder that 'weldcal calibrate' wrote.")
    order = MeasureOrder(
        dataset=measure,
        calibration=calibration,
        tool=file,
        touches=touches,
        scenario=scenario,
        nozzle_mm=nozzle_mm,
        wire_mm=wire_mm,
    )
    report = run_measurement(order, call.folder("tool", file.stem), call.progress)
    return Outcome(
        report.summary(),
        values={},
        rows=report.rows(call.verbose),
        problem="" if report.verdict.tolerance == HOLDS else f"{report.verdict.reason} {report.verdict.cause}".strip(),
    )


@command(
    "tool measure", options=LIVE, defaults={"browser": False}, short_help="Measure the torch by scans and touches."
)
def tool_measure(
    call: Call,
    dataset: Annotated[
        Path | None, typer.Argument(metavar="DATASET", help="Scans of the tool from several sides, poses X_BF.")
    ] = None,
    calibration: CalibrationOption = None,
    tool: Annotated[
        Path | None, option("--tool", "FILE", "Tool file: where the torch should be, or the name of a tool.")
    ] = None,
    touches: TouchesOption = None,
    scenario: CellOption = None,
    scans: Annotated[
        int | None, option("--scans", "N", "Without DATASET: scans of the nozzle.", min=FEWEST, max=MOST)
    ] = None,
    nozzle_mm: NozzleOption = NOZZLE_MM,
    wire_mm: WireOption = WIRE_MM,
) -> Outcome:
    """Measure nozzle, tip and ring by scans of a calibrated cell and the wire's end by touches.

    Without DATASET the arm of --scenario shows its tool to the fixed scanner from all sides. The result is a new tool
    file with the measured torch.
    """
    order = partial(MeasureOrder, touches=touches, scenario=scenario, nozzle_mm=nozzle_mm, wire_mm=wire_mm)
    if dataset is None:
        if scenario is None:
            raise typer.BadParameter("give a folder of scans, or a cell whose arm takes them (--scenario NAME)")
        if tool is not None:
            raise typer.BadParameter("--tool belongs to DATASET: the scenario names its tool")
        showing = showing_tool(scenario, calibration, scans)
        return run_tool_scan(showing, run_options(call, "tool-measure", scenario), order, call.progress)
    if calibration is None or tool is None:
        raise typer.BadParameter("scans need --calibration RESULT and --tool FILE")
    report = run_measurement(
        order(dataset=dataset, calibration=calibration, tool=tool_file(tool)),
        call.folder("tool-measure", dataset.resolve().name),
        call.progress,
    )
    return Outcome(report.summary(), values={}, rows=report.rows(call.verbose))


@command("tool tcp", keys=("robot-form",), short_help="Find the TCP from touches of one point.")
def tool_tcp(
    call: Call,
    file: Annotated[
        Path, typer.Argument(metavar="TOUCHES", help="Flange poses at four or more touches of one point, in any form.")
    ],
    unit: Annotated[str, option("--unit", "U", "m or mm, of the positions.", show_default="the file's")] = "auto",
    tcp: Annotated[
        str,
        option("--tcp", "X,Y,Z,RX,RY,RZ", "The TCP (mm, rad) of the poses, where it was not zero; its turn is kept."),
    ] = "",
    limit_mm: LimitOption = None,
) -> Outcome:
    """Find the TCP as a pendant's four-point method does, with its uncertainty and the error of each touch."""
    check_limit(limit_mm)
    if unit not in ("auto", "m", "mm"):
        raise InputError(f"The unit is m or mm, not '{unit}'.")
    old = _six(tcp)
    form = PoseForm(rotation=call.reading.get("robot-form", ""), tcp=old if tcp else [])
    touches, read_as = read_wire_touches(file, form, unit, must_decide=True)
    folder = call.folder("tool-tcp", file.stem)
    report = TcpReport(find_tcp(touches), touches, read_as, old[3:], limit_mm, folder)
    write_atomic(folder / "set_tcp.script", report.set_tcp + "\n")
    write_json(folder / "tcp.json", report.summary())
    held = report.found.held_out_m
    figures = TableRows(list(report.rows().items()), text=(0, 1))
    page = page_html(
        f"TCP from {file.name}",
        f"{len(touches)} touches. {report.set_tcp}",
        [left_out("touches", "touch", [t.id for t in touches], 1e3 * held), ("Figures", [figures])],
        first=report.first,
        facts=[("SHA-256 of the file", sha256(file))],
    )
    write_atomic(folder / "report.html", page)
    return Outcome(report.summary(), values={}, rows=report.rows(), first=report.first)


def _six(text: str) -> list[float]:
    """Six numbers of a TCP, in metres and radians; zeros for an empty text. Raises InputError."""
    try:
        values = [float(v) for v in text.strip().removeprefix("p").strip("[] ").split(",")] if text else [0.0] * 6
    except ValueError:
        values = []
    if len(values) != 6 or not np.isfinite(values).all():
        raise InputError(f"--tcp holds six numbers, x,y,z in mm and rx,ry,rz in rad, not '{text[:60]}'.")
    return [1e-3 * v for v in values[:3]] + values[3:]


@dataclass(frozen=True, kw_only=True)
class MeasureOrder:
    """What the command was given."""

    dataset: Path
    calibration: Path
    tool: Path
    touches: Path | None
    scenario: str | None
    nozzle_mm: float
    wire_mm: float


@dataclass(frozen=True, eq=False)
class MeasureReport:
    """A measured tool, its verdict, the seam's tolerance mm, the folder of the result, and the next step."""

    found: ToolMeasurement
    verdict: ToolVerdict
    tolerance_mm: float
    folder: Path
    following: str = ""

    def summary(self) -> dict[str, Any]:
        """Return the JSON object: millimetres and degrees in the flange frame."""
        f = self.found
        nan = np.isnan(f.stick_out_m)
        return {
            "state": "done",
            "torch": {
                "xyz_mm": _mm(f.p_FW),
                "axis": [round(float(v), 7) for v in f.axis],
                "touched": f.wire is not None,
                "margin_mm": 1e3 * wire_sigma(f),
                "covariance_mm2": None if f.wire is None else (1e6 * f.wire.covariance).tolist(),
                "stick_out_mm": None if nan else 1e3 * f.stick_out_m,
                "stick_out_sigma_mm": None if nan else 1e3 * f.stick_out_sigma_m,
            },
            "nozzle": {
                "on_axis_mm": _mm(f.p_FN),
                "covariance": f.axis_covariance.tolist(),
                "covariance_of": "shifts (m) then turns (rad) along across",
                "across": f.nozzle.surface.axes[:2].tolist(),
                "scans": f.nozzle.scans,
                "noise_mm": 1e3 * f.nozzle.noise_m,
                "seen_deg": f.seen_deg,
            },
            "touches": None
            if f.wire is None
            else {"used": f.wire.used, "rms_mm": 1e3 * f.wire.rms_m, "left_out": list(f.wire.left_out)},
            "moved": {m.part: _moved(m) for m in f.moves},
            "tolerance_mm": self.tolerance_mm,
            "tolerance": self.verdict.tolerance,
            "reason": self.verdict.reason,
            "cause": self.verdict.cause,
            "notes": list(f.notes),
            "tool_file": str(self.folder / "tool.yaml"),
            "folder": str(self.folder),
        }

    def rows(self, every: bool = True) -> dict[str, str]:
        """What was found, in lines, the verdict first; not `every`: without axis and notes."""
        f = self.found
        rows = {"verdict": self.verdict.reason, "cause": self.verdict.cause}
        for m in f.moves:
            turn = (
                "" if m.turn is None else f", {np.degrees(m.turn_rad):.2f} +- {np.degrees(m.turn_margin_rad):.2f} deg"
            )
            said = "moved by" if m.moved else "in its place:"
            rows[m.part] = f"{said} {1e3 * m.distance_m:.2f} +- {1e3 * m.margin_m:.2f} mm{turn}"
        if not np.isnan(f.stick_out_m) and f.wire is not None:
            rows["stick-out"] = f"{1e3 * f.stick_out_m:.1f} +- {2e3 * f.stick_out_sigma_m:.1f} mm"
        point = "not measured: the wire was not touched" if f.wire is None else "({:.2f}, {:.2f}, {:.2f}) mm"
        rows["wire point"] = point.format(*_mm(f.p_FW))
        if every:
            rows["axis"] = "({:.5f}, {:.5f}, {:.5f})".format(*f.axis)
            rows |= {f"note {k + 1}": note for k, note in enumerate(f.notes)}
        return rows | {"next": self.following, "page": str(self.folder / "report.html")}


def run_measurement(order: MeasureOrder, folder: Path, tell: Callable[[str, float], None]) -> MeasureReport:
    """Measure a tool; write tool.yaml, tool_measurement.json, tool.png and report.html to ``folder``.

    Raises:
        InputError, ToolNotFound: an input cannot be used, or does not show the torch; nothing is written.
    """
    loaded = load_tool(order.tool)
    calibration = load_result(order.calibration)
    touches = () if order.touches is None else read_wire_touches(order.touches)[0]
    welding = WeldingConfig() if order.scenario is None else load_scenario(order.scenario).welding
    tell("reading the scans", 0.05)
    data = load_dataset(order.dataset)
    scans, notes = tool_scans(data, calibration)
    tell("looking for the ring", 0.2)
    standard = loaded.tool.ring
    ring = None if standard is None else find_ring(data, calibration, loaded.tool.X_FR, standard)
    if standard is not None and ring is None:
        notes = (*notes, "Fewer than three scans show the ring: it was not measured.")
    tell("measuring the nozzle", 0.5)
    found = measure_tool(
        loaded,
        scans,
        calibration.covariance,
        touches,
        part=NozzlePart(length_m=1e-3 * order.nozzle_mm),
        wire_m=1e-3 * order.wire_mm,
        ring=ring,
        notes=notes,
    )
    following = typed("tool check", folder / "tool.yaml")
    if found.wire is None:
        again = f"{typed('tool measure', order.dataset)} --calibration {shlex.quote(str(order.calibration))}"
        again += f" --tool {shlex.quote(str(order.tool))} --touches wire_touches.csv"
        following = f"Touch one point with the wire's end in twelve orientations: wire_touches.csv. Then:\n{again}"
    verdict = judge_tool(found, 1e-3 * welding.tolerance_mm)
    report = MeasureReport(found, verdict, welding.tolerance_mm, folder, following)
    tell("writing", 0.9)
    write_atomic(folder / "tool.yaml", tool_text(found, measured_file(found), str(order.dataset)))
    picture = tool_picture(load_tool(folder / "tool.yaml"))
    write_atomic(folder / "tool.png", picture)
    tone: Mapping[str, str] = {HOLDS: "good", EXCEEDED: "bad"}
    tolerance = verdict.tolerance
    headline = f"{'Whether the seam tolerance holds' if tolerance == UNKNOWN else 'The seam tolerance'} {tolerance}"
    rows = [row for row in report.rows().items() if row[0] not in ("verdict", "cause", "next", "page")]
    drawn = Shot(picture, "The measured tool from three sides, drawn from its file.", "Drawing of the measured tool")
    page = page_html(
        f"Tool {loaded.name}, measured",
        f"Against {order.tool.name}; millimetres and degrees in the flange frame, with what is not exceeded at 95 %",
        [("", [TableRows(rows, ("part", "found"), (0, 1)), drawn])],
        verdict=(tone.get(tolerance, "warn"), headline, f"{verdict.reason} {verdict.cause}".strip()),
    )
    write_atomic(folder / "report.html", page)
    write_json(folder / MEASURED_TOOL, report.summary())
    return report


def showing_tool(name: str, calibration: Path | None, scans: int | None = None) -> Scenario:
    """Return a scenario as one whose arm shows its tool to the scanner of a calibration; None: of its tool_scan.

    Raises:
        InputError: the scanner is not fixed, or the result cannot be used.
    """
    scenario = load_scenario(name)
    if not hasattr(scenario, "tool_scan"):
        raise InputError("This installation has no tool scan.")
    config = scenario.part(ToolScanConfig) or ToolScanConfig()
    result = Path(config.result) if calibration is None else calibration
    if result == Path():
        raise InputError("The tool is scanned with a calibrated scanner: give --calibration RESULT.")
    scenario.tool_scan = replace(config, result=str(result), scans=scans or config.scans)
    scenario.job.calibrate = scenario.job.weld = False
    check_tool_scan(scenario)  # first: its sentences name this job
    use_kinematics(scenario, result)
    check_scenario(scenario)
    return scenario


def run_tool_scan(
    scenario: Scenario, options: RunOptions, order: Callable[..., MeasureOrder], progress: Callable[[str, float], None]
) -> Outcome:
    """Let the arm show its tool, write the scans as a dataset, and measure the tool by them.

    Raises:
        InputError, UnreachableScanner, RobotRefused: see run_job; nothing has been written or moved.
    """
    finished = run_job(scenario, options, progress, "tool_scan")
    run, folder, scanner, loaded = (
        finished.run,
        options.out / "scans",
        scenario.scanner_config(),
        scenario.loaded_tool(),
    )
    poses, config = run.cell.job.poses(run.root), scenario.part(ToolScanConfig)
    assert scanner is not None
    assert loaded is not None
    assert config is not None
    preset = scanner.scanner()
    if poses:
        save_dataset(
            folder,
            DatasetHeader(
                robot=scenario.arm,
                flange=scenario.flange_name(),
                scanner=preset.name,
                configuration="eye_on_base",
                note=f"scans of the tool; robot: {finished.robot}",
            ),
            {id: X_BF for id, (X_BF, _) in poses.items()},
            {id: run.scans[id][0].points_C.astype(float) for id in poses},
            joints={id: q for id, (_, q) in poses.items()},
            intrinsics=(preset.fx, preset.fy, preset.cx, preset.cy),
        )
    finished.write_recording(options.out)
    about = {"scenario": options.scenario, "seed": options.seed, "scans": len(poses), "dataset": str(folder)}
    if run.held:
        held = {"state": "held", "reason": run.reason or ""}
        return Outcome(held | about | run.timing(), values={}, problem=run.reason or "")
    asked = order(dataset=folder, calibration=Path(config.result), tool=loaded.file)
    report = run_measurement(asked, options.out, lambda stage, share: progress(stage, 0.9 + 0.1 * share))
    return Outcome(report.summary() | about | run.timing(), values={}, rows={**report.rows(), "scans": str(len(poses))})


def _mm(p: Any) -> list[float]:
    return [round(1e3 * float(v), 4) + 0.0 for v in p]


def _moved(m: Move) -> dict[str, object]:
    return {
        "moved": m.moved,
        "by_mm": 1e3 * m.distance_m,
        "shift_mm": _mm(m.shift),
        "margin_mm": 1e3 * m.margin_m,
        "turned_deg": None if m.turn is None else float(np.degrees(m.turn_rad)),
        "turn_margin_deg": None if m.turn is None else float(np.degrees(m.turn_margin_rad)),
    }
