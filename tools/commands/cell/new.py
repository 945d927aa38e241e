"""weldcal new: a commented cell of one's own with every key, or an example of a calibration dataset."""

import dataclasses as dc
import json
import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import write_atomic
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.scanners import cast
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.part import Part, WeldPart, numbered, seam_count
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.models.workpieces.step import referenced
from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning, plan_drawn_seam, plan_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.messages import PlannedSeam, Scan
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import ErrorConfig, PoseConfig, Scenario, SeamConfig, ToolFile, WorkpieceConfig
from weldcal.systems.station import Station, make_station
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.commands.cell.dataset_forms import FORMS, rewrite
from weldcal.tools.commands.cell.scan_poses import add_scan_poses
from weldcal.tools.commands.cell.schema import SchemaKey, json_schema, keys_of, yaml_of
from weldcal.tools.commands.cell.screen import MOST_TRIED, joint_of, least_pipe, to_try, unit_hint, ways
from weldcal.tools.commands.run import run_job
from weldcal.tools.commands.weld import write_scans
from weldcal.tools.report.first_screen import typed
from weldcal.tools.report.run import RunOptions
from weldcal.welding.seam.clearance import NoClearance, check_beside

BASE, EXAMPLE = "s_groove", "calibrate_only"
SMALL = "scanner: {width: 412, height: 308}"  # pixels of the example's scans: a few hundred kB each
README = """# An example of a calibration dataset

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, the units, and where the scanner stands roughly
    poses.csv      id, x, y, z (m), qw, qx, qy, qz, time (s): the flange in the robot's base, TCP zero, at each scan
    clouds/ID.npz  the scan of that pose in the camera's frame; ply and pcd are read too

Put your own scans and poses in their place. Eight to twelve poses, tilted and turned, spread over the working volume,
are a good number.
"""
OTHER = """# An example of a calibration dataset: {form}

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, and where the scanner stands roughly
    {files}

docs/datasets.md lists the forms that are read. Put your own scans and poses in the place of these.
"""
FILES = {
    "ur": (
        "poses.txt      p[x, y, z, rx, ry, rz] (m, rad) of the flange, TCP zero, one line a scan, in the order of"
        " clouds/"
    ),
    "matrices": "poses/ID.txt   X_BF, the flange in the robot's base, 4 x 4, row by row (m); clouds/ID.npz is its scan",
    "opencv": (
        "robot_poses.yml OpenCV FileStorage with a node for each scan: X_BF, 4 x 4 (m); clouds/ID.npz is its scan"
    ),
    "zivid": (
        "pos01.yaml     X_BF as PoseState, 4 x 4 (mm); img01.pcd is its scan (mm), in place of Zivid's closed .zdf"
    ),
    "ros": "tool_pose.csv  X_BF of each scan as 'rostopic echo -p' prints it, in the order of clouds/",
    "mcap": "recording/     a ROS 2 recording: PointCloud2 and PoseStamped",
}
CELL, UNFINISHED, SCHEMA = "cell.yaml", "unfinished.yaml", "cell.schema.json"
WIDTH = 120
LEFT_OUT = ("extends", "visualization")
HEAD = """# yaml-language-server: $schema={schema}
{state}
# A key behind a `#` has its default: remove the `#` to change it. Positions are in the robot's base, in metres;
# `rpy_deg` are roll, pitch and yaw about fixed axes. All keys: docs/scenario.md. With real devices:
# docs/your_cell.md, and
#   weldcal check-cell {path}
"""
TOOL = "tool.yaml"
TURNS_DEG = (90.0, -90.0, 0.0, 180.0)
TABLE_M = (0.7, 0.7)  # half the size of the table in the scan that is tried
OFF_MM, OFF_DEG = 6.0, 1.5  # of the simulated part from its guess: the scan has to find it
MOST_PLANNING_S = 60.0  # of processor time for the seams of a part: a choice, a user waits no longer
TABLE_PITCH_M = 0.004  # between its points: a choice, fine beside a finger
PLACE_M = (0.65, 0.0)  # of the part's middle, where the demo's plate lies


RUNS = """# A cell of your own. It runs as it is, in simulation:
#   weldcal demo --scenario {path}"""
CANNOT_WELD = """# A cell of your own, unfinished: the arm cannot weld the seam of its part yet.
# {reason}
# Change seams or pose_guess of the workpiece, then run it in simulation:
#   weldcal demo --scenario {path}"""


@command("new", common=("seed", "json", "debug"), short_help="Write a cell or a dataset of your own to start from.")
def new(
    call: Call,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to write it.")],
    base: Annotated[str, option("--from", "NAME", "Scenario that the cell begins as, by name or path.")] = BASE,
    part: Annotated[
        Path | None, option("--part", "FILE", "A part of your own: STEP, STL, OBJ or PLY. It is copied there.")
    ] = None,
    edges: Annotated[
        str, option("--edges", "N,N...", "Edges of the seam, from weldcal part; default: the best that can be welded.")
    ] = "",
    joint: Annotated[
        str | None, option("--joint", "NAME", "v_groove, butt, fillet or lap; default: by the angle.")
    ] = None,
    units: Annotated[str | None, option("--units", "UNIT", "Of the part's file: mm, m or inch.")] = None,
    tool: Annotated[bool, switch("--tool", "Also write tool.yaml, a copy of the welding tool to change.")] = False,
    tool_of: Annotated[
        Path | None, option("--tool-file", "FILE", "Weld with this tool; tip_1p5 is weldcal's for laps from 1.5 mm.")
    ] = None,
    dataset: Annotated[
        bool, switch("--dataset", "Write an example of a calibration dataset, scanned in simulation, instead.")
    ] = False,
    form: Annotated[
        str,
        option("--format", "NAME", "With --dataset: ur, matrices, opencv, zivid, ros or mcap; default: weldcal's own."),
    ] = "",
) -> Outcome:
    """Write a commented scenario that runs, cell.yaml, with a schema for editors; or an example of a calibration
    dataset."""
    if form and not dataset:
        raise typer.BadParameter("--format is for --dataset")
    if dataset:
        if not call.json:
            typer.echo("The scans are rendered in simulation, which takes about two minutes.")
        written = write_example(folder, call.seed, call.progress, form)
        following, note = typed("calibrate", written), {}
    else:
        numbers = tuple(edge_numbers(edges))
        own = None if part is None else OwnPart(part, numbers, joint, units)
        written, reason = write_cell(folder, base, own, tool_file(tool_of or WELDING) if tool or tool_of else None)
        following = typed("demo --scenario", written)
        if part is not None and written.name == UNFINISHED:
            problem = (
                f"The arm cannot weld {part.name} in any of the poses that were tried: {reason} "
                f"Choose other edges from '{typed('part', part)}' and give --edges, or change {written}."
            )
            summary = {"state": "unfinished", "reason": problem, "written": str(written)}
            return Outcome(summary, values={"written": str(written)}, problem=problem)
        note = {"note": reason} if reason else {}
        spec = load_scenario(str(written)).workpiece
        if part is not None and spec is not None:
            note = {"seams": "; ".join("edges " + ", ".join(map(str, seam.edges)) for seam in spec.seams)} | note
    values = {"written": str(written), **note, "next": following}
    return Outcome({"state": "done", **values}, values=values)


def edge_numbers(text: str) -> list[int]:
    """Return the numbers of a list such as 12,13. Raises InputError."""
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not all(word.isdecimal() for word in words):
        raise InputError(f"--edges must be numbers with commas between them, such as 12,13, not '{text}'.")
    return [int(word) for word in words]


def write_example(folder: Path, seed: int, progress: Progress = no_progress, form: str = "") -> Path:
    """Scan a flange in simulation and write the scans as a dataset, in weldcal's own form or another (ur ...).

    Raises:
        InputError: there is something in the folder already, or no such form.
    """
    if form and form not in FORMS:
        raise InputError(f"There is no form '{form}': use {', '.join(FORMS)}.")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"'{folder}' is not empty: choose another folder.")
    scenario = load_scenario(EXAMPLE, SMALL)
    finished = run_job(scenario, RunOptions(scenario=EXAMPLE, out=folder, seed=seed, recording=False), progress, "")
    progress("write", 0.99)
    status = finished.cell.job.calibration_status(finished.run.root)
    written = write_scans(finished.run, status, folder)
    if written is None:
        raise InputError("No scan of the flange was taken: give another --seed.")
    text = OTHER.format(folder=folder, form=form, files=FILES[form]) if form else README.format(folder=folder)
    if form:
        rewrite(folder, form)
    write_atomic(folder / "README.md", text)
    return written


@dataclass(frozen=True)
class OwnPart:
    """A part's file, the seam's edges (none: the best), the joint (None: by its angle) and the unit."""

    file: Path
    edges: tuple[int, ...] = ()
    joint: str | None = None
    units: str | None = None


def write_cell(folder: Path, base: str, part: OwnPart | None = None, tool: Path | None = None) -> tuple[Path, str]:
    """Write cell.yaml and its JSON schema into a folder, with a part and a tool of one's own.

    Returns:
        The path of cell.yaml, and ""; where the arm can weld a seam only in pieces, which, and why. Where the arm can
        weld the part's seam in no pose that was tried: the path of unfinished.yaml, and the reason in the pose that
        came nearest.

    Raises:
        InputError: there is one already, `base` is no scenario, or the part cannot be used.
    """
    scenario = load_scenario(base)
    path = folder / CELL
    if path.exists():
        raise InputError(f"There is a cell in '{folder}' already: choose another folder, or delete {CELL}.")
    folder.mkdir(parents=True, exist_ok=True)
    if part is not None:
        scenario.description = f"A cell that welds {part.file.name}."
        fits = load_tool(WELDING if tool is None else tool).tool
        candidates = add_part(scenario, folder, part, fits)
    if tool is not None:
        add_tool(scenario, folder, tool)
    write_atomic(folder / SCHEMA, json.dumps(json_schema(), indent=1) + "\n")
    unfinished = folder / UNFINISHED
    note = ""
    if part is not None:
        assert scenario.workpiece is not None
        standing, refusals = scenario.workpiece.pose_guess, dict[int, str]()  # by edge: why the seam along it is none
        for seams, joint, pieces in candidates:
            reason, note = _refused(unfinished, scenario, seams, joint, standing, False), pieces
            if not reason:
                break
            refusals = dict.fromkeys(seams[0].edges, reason) | refusals
        if reason:
            (seams, joint, _), shape = candidates[0], read_shape(part.file, part.units)
            nearest = _refused(unfinished, scenario, seams, joint, standing, True) or refusals[seams[0].edges[0]]
            whole = sum(not note for *_, note in candidates)
            several = f"None of {whole} seams can be welded; the nearest one: " if whole > 1 else ""
            reason = _with_advice(shape, seams[0], fits, several + nearest)
            scenario.workpiece = dc.replace(scenario.workpiece, seams=seams, joint=joint, pose_guess=standing)
            _write(unfinished, scenario, CANNOT_WELD.format(reason=_comment(reason), path=unfinished))
            return unfinished, reason
        if note:
            note = f"{note} As a whole: {refusals[seams[0].edges[0]]}"
        # The part is planned on the branch of home, and will not lie exactly as drawn.
        scenario.welding.posture = "any"
    _write(path, scenario, (RUNS + f"\n# {_comment(note)}" * bool(note)).format(path=path))
    unfinished.unlink(missing_ok=True)
    return path, note


def _comment(text: str) -> str:
    return "\n# ".join(textwrap.wrap(text, WIDTH - 2)).replace("{", "{{").replace("}", "}}")


def _refused(
    path: Path, scenario: Scenario, seams: list[SeamConfig], joint: str, standing: PoseConfig, advises: bool
) -> str:
    """Write a scenario with seams, and place its part; why the arm can weld them in no pose, else ""."""
    assert scenario.workpiece is not None
    scenario.workpiece = dc.replace(scenario.workpiece, seams=seams, joint=joint, pose_guess=standing)
    _write(path, scenario, CANNOT_WELD.format(reason="Its place is not chosen yet.", path=path))
    scenario.workpiece.pose_guess, reason = weldable_place(load_scenario(str(path)), advises)
    return add_scan_poses(scenario, path, reason)


def planned(part: OwnPart, seams: list[list[PartEdge]], tool: Path, progress: Progress) -> list[tuple[str, str]]:
    """Why a new cell's arm cannot weld each seam of a part, given by its edges, in any pose that is tried, else "".

    And in which pieces it can; "" where it can as a whole. After MOST_PLANNING_S the rest of the seams is not asked.
    """
    found, began = list[tuple[str, str]](), process_time()
    with TemporaryDirectory() as folder:
        scenario = load_scenario(BASE)
        first, shape = dc.replace(part, edges=tuple(edge.id for edge in seams[0])), read_shape(part.file, part.units)
        add_part(scenario, Path(folder), first, load_tool(tool).tool)
        add_tool(scenario, Path(folder), tool)
        assert scenario.workpiece is not None
        standing = scenario.workpiece.pose_guess
        for k, edges in enumerate(seams):
            if process_time() - began > MOST_PLANNING_S:
                break
            progress(f"plan seam {k + 1} of {len(seams)}", 0.3 + 0.6 * k / len(seams))
            reason = ""
            for tried, pieces in ways(shape, [edge.id for edge in edges])[:3]:
                why = _refused(Path(folder) / CELL, scenario, tried, joint_of(edges[0]), standing, False)
                reason, note = reason or why, pieces
                if not why:
                    break
            found.append((reason if why else "", "" if why else note))
    return found


def _write(path: Path, scenario: Scenario, state: str) -> None:
    head = HEAD.format(schema=SCHEMA, path=path, state=state)
    write_atomic(path, head + "".join(_parts(scenario)))


def _parts(scenario: Scenario) -> Iterator[str]:
    meanings = {key.name: key.meaning for key in keys_of(Scenario)}
    for key in keys_of(type(scenario)):
        value = getattr(scenario, key.name)
        absent = isinstance(value, NoDevice) and isinstance(key.default, NoDevice)
        if key.name in LEFT_OUT or (value is None and key.parts) or absent:
            continue
        meaning = meanings.get(key.name) or key.meaning
        if not dc.is_dataclass(value):
            yield _line(dc.replace(key, meaning=meaning), value, "")
            continue
        tag = f" !{type(value).__name__}" if key.name in DEVICES else ""
        comment = f"# {meaning}\n" if meaning else ""
        below = "".join(_below(value, "  "))
        yield f"\n{comment}{key.name}:{tag}" + (f"\n{below}" if below else " {}\n")


def _below(config: Any, indent: str) -> Iterator[str]:
    keys = keys_of(type(config))
    changed = any(getattr(config, key.name) != key.default for key in keys)
    for k, key in enumerate(keys):
        # a mapping needs one key
        yield _line(key, getattr(config, key.name), indent, written=k == 0 and not changed)


def _line(key: SchemaKey, value: Any, indent: str, written: bool = False) -> str:
    """Return the key with its value, behind a comment sign where that is the default, and what it means."""
    meaning = key.meaning
    mark = "# " if value == key.default and not written and key.name != "description" else ""
    text = f"{indent}{mark}{key.name}: {yaml_of(value)}"
    if not meaning:
        return text + "\n"
    if len(text) + 4 + len(meaning) <= WIDTH:
        return f"{text}  # {meaning}\n"
    above = textwrap.wrap(meaning, WIDTH - len(indent) - 2)
    return "".join(f"{indent}# {words}\n" for words in above) + text + "\n"


def add_part(
    scenario: Scenario, folder: Path, part: OwnPart, tool: WeldingTool
) -> list[tuple[list[SeamConfig], str, str]]:
    """Copy a part's file into the cell's folder, and make it the scenario's workpiece, standing on the table.

    Returns:
        What to try, each the seams, their joint and what of the part's seam they are, "" for the whole; the best first.

    Raises:
        InputError: the part cannot be read, has no such edge, or no joint.
    """
    shape = read_shape(part.file, part.units)
    chosen = [[shape.edge(id) for id in part.edges]] if part.edges else to_try(shape, part.file, tool)
    found = [
        (seams, part.joint or joint_of(edges[0]), note)
        for edges in chosen
        for seams, note in ways(shape, [e.id for e in edges])
    ]
    if part.edges:
        found = [way for way in found if not way[2] or len(way[0]) > 1]  # only what welds all of it
    whole, rest = [way for way in found if not way[2]], [way for way in found if way[2]]
    found = [*whole, *sorted(rest, key=lambda way: len(way[0]) == 1)[:MOST_TRIED]]
    scenario.workpiece = WorkpieceConfig(
        file=part.file.name,
        units=part.units,
        seams=found[0][0],
        joint=found[0][1],
        pose_guess=_standing(shape.mesh, TURNS_DEG[0], 0.5 * shape.mesh.bounds.sum(axis=0), scenario),
        located_by="scan",
        placement_error=ErrorConfig(OFF_MM, OFF_DEG),
    )
    for file in (part.file, *referenced(part.file)):
        shutil.copyfile(file, folder / file.name)
    return found


def _with_advice(shape: PartShape, seam: SeamConfig, tool: WeldingTool, reason: str) -> str:
    """Why no seam of a part can be welded, with what its size and a round seam say of that."""
    ring = next((joint for joint in shape.joints if list(joint.edges) == seam.edges), None)
    least = "" if ring is None or "tool does not fit" not in reason else least_pipe(shape, ring, tool)
    return f"{unit_hint(shape)} {reason}{least}".strip()


def weldable_place(scenario: Scenario, advises: bool = True) -> tuple[PoseConfig, str]:
    """Return the first of some poses on the table in which the arm can weld the seams of a scenario's part, and "".

    There it must also be found in a scan: else the reason is why not. Where there is none: the scenario's own pose, and
    the reason of the try in which the most seams could be welded; `advises`: with what would help.
    """
    assert scenario.workpiece is not None
    own = scenario.workpiece.pose_guess
    try:
        station = make_station(scenario, 0)
    except WeldcalError as error:
        return own, str(error)
    nearest, nearest_pose = (-1.0, ""), own
    try:
        part = station.cad
        if not isinstance(part, Part) or station.tool is None:
            return (
                own,
                "Only a part from a file and a welding tool can be planned. Choose another scenario with --from.",
            )
        seams = [numbered(part, k) for k in range(seam_count(part))]
        line = np.concatenate([seam.seam_P for seam in seams])
        middles = [0.5 * part.mesh.bounds.sum(axis=0), 0.5 * (line.min(axis=0) + line.max(axis=0))]
        middles = middles[: 1 + bool(np.ptp(middles, axis=0).max() > 0.005)]  # nearer they are one place
        for guess in (_standing(part.mesh, turn, middle, scenario) for middle in middles for turn in TURNS_DEG):
            welded, reason = _first_refusal(scenario, station, seams, guess)
            if not reason:
                return guess, _unseen(scenario, station, seams[0], guess)
            if welded > nearest[0]:
                nearest, nearest_pose = (welded, reason), guess
        if advises:
            nearest = _first_refusal(scenario, station, seams, nearest_pose, advises=True)
    finally:
        station.close()
    return own, nearest[1]


def _first_refusal(
    scenario: Scenario, station: Station, seams: list[WeldPart], guess: PoseConfig, advises: bool = False
) -> tuple[float, str]:
    """Count the seams before the first that the arm cannot weld with the part in a pose, and say why ("": all)."""
    for number, part in enumerate(seams):
        config = servo_config(scenario, station, number)
        planning = dc.replace(
            seam_planning(scenario, station, config), workpiece=part, X_BP_guess=guess.pose(), advises=advises
        )
        plan = plan_drawn_seam(planning, 0)
        if plan.reason is not None:
            return number, plan.reason
        if reason := _at_the_table(planning, part, plan):
            return number + 0.5, reason  # nearer to a weld than where the arm has no way
    return len(seams), ""


def _at_the_table(planning: SeamPlanning, part: WeldPart, plan: PlannedSeam) -> str:
    """Why the tool would touch the table along a planned seam; "" where it would not."""
    assert plan.seam is not None
    p_B = np.asarray(plan.seam.position(np.linspace(0.0, plan.seam.length, 50)))[:, :2]
    x, y = (np.arange(low, high, TABLE_PITCH_M) for low, high in zip(p_B.min(0) - 0.2, p_B.max(0) + 0.2, strict=True))
    table = np.stack(np.meshgrid(x, y, [planning.table_z_m]), axis=-1).reshape(-1, 3)
    try:
        check_beside(table, part.mesh, planning.X_BP_guess, plan.seam, planning.tool, plan.lean_rad, planning.table_z_m)
    except NoClearance as error:
        return str(error)
    return ""


def _unseen(scenario: Scenario, station: Station, part: WeldPart, guess: PoseConfig) -> str:
    """Why the job does not find a part in a scan of it, turned and displaced as the scenario says; "" where it does."""
    scanner, placed = scenario.scanner, scenario.workpiece
    if (
        not isinstance(scanner, RenderedScanner)
        or scanner.mounted_on != "base"
        or placed is None
        or placed.located_by != "scan"
    ):
        return ""
    X_BC = PoseConfig(list(scanner.xyz_m), list(scanner.rpy_deg)).pose()
    off = RotationMatrix.MakeZRotation(np.deg2rad(placed.placement_error.rotation_deg))
    middle = guess.pose() @ (0.5 * part.mesh.bounds.sum(axis=0))
    shift = 1e-3 * placed.placement_error.translation_mm * np.array([0.8, 0.6, 0.0])
    X_BP = RigidTransform(off, middle + shift - off @ middle) @ guess.pose()
    low, high = PLACE_M - np.array(TABLE_M), PLACE_M + np.array(TABLE_M)
    z = scenario.calibration.table_z_m
    table = extrude(np.array([low, (high[0], low[1]), high, (low[0], high[1])]), z - 0.02, z)
    cloud_B = cast([part.mesh.transformed(X_BP), table], X_BC, scanner.scanner(), 0)
    X_CB = X_BC.inverse()
    points_C = (cloud_B @ X_CB.rotation().matrix().T + X_CB.translation()).astype(np.float32)
    config = servo_config(scenario, station, 0)
    planning = dc.replace(
        seam_planning(scenario, station, config), workpiece=part, X_BP_guess=guess.pose(), advises=False
    )
    return plan_seam(planning, Scan(sequence=1, points_C=points_C), X_BC, ScannerCorrection()).reason or ""


def _standing(mesh: TriMesh, turn_deg: float, middle_P: NDArray[np.float64], scenario: Scenario) -> PoseConfig:
    """Return the pose of a part on the table as it is drawn, turned about z, with a point of it at PLACE_M."""
    R = RotationMatrix.MakeZRotation(np.deg2rad(turn_deg)).matrix()
    x, y = np.array(PLACE_M) - (R @ middle_P)[:2]
    z = scenario.calibration.table_z_m - float(mesh.bounds[0, 2])
    return PoseConfig([round(float(v), 4) for v in (x, y, z)], [0.0, 0.0, turn_deg])


def add_tool(scenario: Scenario, folder: Path, tool: Path) -> None:
    """Make a file the scenario's tool; one of weldcal's is copied into the cell's folder as tool.yaml."""
    ours = tool.parent == WELDING.parent
    if ours:
        shutil.copyfile(tool, folder / TOOL)
    scenario.tool = ToolFile(TOOL if ours else str(tool.resolve()))
