"""weldcal new: a commented cell of one's own with every key, or an example of a calibration dataset."""

import dataclasses as dc
import json
import math
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartShape
from weldcal.models.workpieces.step import referenced
from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import ErrorConfig, Scenario, ToolFile, WorkpieceConfig
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.commands.cell.dataset_forms import FORMS, rewrite
from weldcal.tools.commands.cell.scan_poses import TURNS_DEG, OutOfTimeError, add_scan_poses, standing, weldable_places
from weldcal.tools.commands.cell.schema import SchemaKey, json_schema, keys_of, yaml_of
from weldcal.tools.commands.cell.screen import (
    Offer,
    joint_of,
    least_pipe,
    ranked,
    unfit,
    unit_hint,
    used_s,
    ways,
    without,
)
from weldcal.tools.report.first_screen import typed

BASE = "s_groove"
EXAMPLE = Path(__file__).parent / "example_scans"  # made by tests/documents/example_scans.py
README = """# An example of a calibration dataset

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner, the units
    poses.csv      id, x, y, z (m), qw, qx, qy, qz: the flange in the robot's base, TCP zero, at each scan
    clouds/ID.npz  the scan of that pose in the camera's frame; ply and pcd are read too

Put your own scans and poses in their place. Eight to twelve poses, tilted and turned, spread over the working volume,
are a good number.
"""
OTHER = """# An example of a calibration dataset: {form}

Scans of a robot's bare flange, taken in simulation. Calibrate with: weldcal calibrate {folder}

    dataset.yaml   the robot, its flange, the scanner
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
MOST_SCANS = 20  # with an own part: a saddle of a stranger had 0.172 mm after 12, and 0.172 sqrt(12 / 20) = 0.133
LEFT_OUT = ("extends", "visualization")
HEAD = """# yaml-language-server: $schema={schema}
{state}
# A key behind a `#` has its default: remove the `#` to change it. Positions are in the robot's base, in metres;
# `rpy_deg` are roll, pitch and yaw about fixed axes. All keys: docs/scenario.md. With real devices:
# docs/your_cell.md, and
#   weldcal check-cell {path}
"""
TOOL = "tool.yaml"
OFF_MM, OFF_DEG = 6.0, 1.5  # of the simulated part from its guess: the scan has to find it
MOST_TRIED = 4  # seams of a part for which a place is looked for
MOST_PART_S = 32.0  # of processor time of weldcal part with its planning: a choice, a user waits no longer


RUNS = """# A cell of your own. It runs as it is, in simulation:
#   weldcal demo --scenario {path}"""
CANNOT_WELD = """# A cell of your own, unfinished: the arm cannot weld the seam of its part yet.
# {reason}
# Change seams or pose_guess of the workpiece, then run it in simulation:
#   weldcal demo --scenario {path}"""


@command("new", common=("seed", "json", "debug"), short_help="Write a cell or a dataset of your own to start from.")
def new(
    call: Call,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where to write it.", writable=True)],
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
        bool, switch("--dataset", "Write an example of a calibration dataset instead: twelve scans, from simulation.")
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
        written = write_example(folder, form)
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


def write_example(folder: Path, form: str = "") -> Path:
    """Write the scans that weldcal brings as a dataset, in weldcal's own form or another (ur ...).

    Raises:
        InputError: there is something in the folder already, or no such form.
    """
    if form and form not in FORMS:
        raise InputError(f"There is no form '{form}': use {', '.join(FORMS)}.")
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"'{folder}' is not empty: choose another folder.")
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    text = OTHER.format(folder=folder, form=form, files=FILES[form]) if form else README.format(folder=folder)
    if form:
        rewrite(folder, form)
    write_atomic(folder / "README.md", text)
    return folder


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
        chains = add_part(scenario, folder, part, fits)
    if tool is not None:
        add_tool(scenario, folder, tool)
    write_atomic(folder / SCHEMA, json.dumps(json_schema(), indent=1) + "\n")
    unfinished = folder / UNFINISHED
    note = ""
    if part is not None:
        assert scenario.workpiece is not None
        shape, begun, refused = read_shape(part.file, part.units), scenario.workpiece, dict[int, str]()
        for ids in chains:
            offers, why = offered(unfinished, scenario, shape, ids, part.joint)
            refused |= why
            if offers:
                break
        if not offers:
            reason = _with_advice(shape, unfinished, scenario, fits, len(chains), refused)
            _write(unfinished, scenario, CANNOT_WELD.format(reason=_comment(reason), path=unfinished))
            return unfinished, reason
        best, note = offers[0], offers[0].note
        scenario.workpiece = dc.replace(begun, seams=best.seams, joint=best.joint, pose_guess=best.pose)
        scenario.planning.scan_poses_deg = best.scan_poses_deg
        # The part is planned on the branch of home, and will not lie exactly as drawn.
        scenario.welding.posture = "any"
    _write(path, scenario, (RUNS + f"\n# {_comment(note)}" * bool(note)).format(path=path))
    unfinished.unlink(missing_ok=True)
    return path, note


def _comment(text: str) -> str:
    return "\n# ".join(textwrap.wrap(text, WIDTH - 2)).replace("{", "{{").replace("}", "}}")


def offered(
    path: Path,
    scenario: Scenario,
    shape: PartShape,
    ids: Sequence[int],
    joint: str | None = None,
    until_s: float = math.inf,
) -> tuple[list[Offer], dict[int, str]]:
    """Say what of a part's edges the arm of a cell can weld: the one rule of `part`, its page and `new`.

    Args:
        path: where the scenario is written for each try.
        scenario: the cell; its workpiece is the part, at the pose from which the others follow.
        shape: the part.
        ids: edges, as far as possible in the order of travel.
        joint: of the seams; None: by the angle.
        until_s: by `used_s`, after which nothing is planned.

    Returns:
        What can be welded, each with the part in one pose, the longest first, and why not by edge.

    Raises:
        OutOfTimeError: not done until then.
    """
    spec, refused = scenario.workpiece, dict[int, str]()
    assert spec is not None
    kind = joint or joint_of(shape.edge(ids[0]))
    try:
        for seams, note, apart in ways(shape, ids):
            scenario.workpiece = dc.replace(spec, seams=seams, joint=kind)
            places, why = weldable_places(_loaded(path, scenario), apart, until_s=until_s)
            reasons = {id: why[k] for k, seam in enumerate(seams) for id in seam.edges if k in why}
            found = list[Offer]()
            for pose, chosen in places or [(spec.pose_guess, list(range(len(seams))))]:
                some = [seams[k] for k in chosen]
                scenario.workpiece = dc.replace(spec, seams=some, joint=kind, pose_guess=pose)
                _loaded(path, scenario)
                if reason := add_scan_poses(scenario, path) if places else next(iter(reasons.values())):
                    reasons |= {id: reason for seam in some for id in seam.edges if places or not apart}
                else:
                    scans = scenario.planning.scan_poses_deg
                    found.append(Offer(seams=some, joint=kind, pose=pose, note=note, scan_poses_deg=scans))
            refused |= reasons
            if found and not apart:
                return found, {}
            if apart:
                refused |= {id: reason for id in ids if (reason := unfit(shape.edge(id)))}
                welded = {id for offer in found for id in offer.edges}
                refused = {id: refused[id] for id in ids if id not in welded}
                kept = [dc.replace(o, note=without([id for id in ids if id not in o.edges], refused)) for o in found]
                return kept, refused
    finally:
        scenario.workpiece = spec
    return [], refused


def planned(
    part: OwnPart, chains: list[tuple[int, ...]], tool: Path, progress: Progress, began_s: float | None = None
) -> list[tuple[list[Offer], dict[int, str]]]:
    """Say of each chain of a part's edges what a new cell's arm can weld of it, as `offered`.

    MOST_PART_S after `began_s`, by `used_s`, the rest of the chains is not asked; without it, after this call.
    """
    until_s = MOST_PART_S + (used_s() if began_s is None else began_s)
    found = list[tuple[list[Offer], dict[int, str]]]()
    with TemporaryDirectory() as folder:
        scenario, shape = load_scenario(BASE), read_shape(part.file, part.units)
        add_part(scenario, Path(folder), dc.replace(part, edges=chains[0]), load_tool(tool).tool)
        add_tool(scenario, Path(folder), tool)
        for k, ids in enumerate(chains):
            progress(f"plan seam {k + 1} of {len(chains)}", 0.3 + 0.6 * k / len(chains))
            try:
                found.append(offered(Path(folder) / CELL, scenario, shape, ids, until_s=until_s))
            except OutOfTimeError:
                break
    return found


def _loaded(path: Path, scenario: Scenario) -> Scenario:
    _write(path, scenario, CANNOT_WELD.format(reason="Its place is not chosen yet.", path=path))
    return load_scenario(str(path))


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


def add_part(scenario: Scenario, folder: Path, part: OwnPart, tool: WeldingTool) -> list[tuple[int, ...]]:
    """Copy a part's file into the cell's folder, and make it the scenario's workpiece, standing on the table.

    Returns:
        The edges of each seam to try, at most MOST_TRIED, the best first.

    Raises:
        InputError: the part cannot be read, has no such edge, or no joint.
    """
    shape = read_shape(part.file, part.units)
    chains = [part.edges] if part.edges else [seam.joint.edges for seam in ranked(shape, tool)][:MOST_TRIED]
    if not chains:
        raise InputError(
            f"{part.file.name} has no concave edge: choose edges with '{typed('part', part.file)}' and give --edges."
        )
    seams = ways(shape, chains[0])[0][0]
    scenario.workpiece = WorkpieceConfig(
        file=part.file.name,
        units=part.units,
        seams=seams,
        joint=part.joint or joint_of(shape.edge(chains[0][0])),
        pose_guess=standing(shape.mesh, TURNS_DEG[0], 0.5 * shape.mesh.bounds.sum(axis=0), scenario),
        located_by="scan",
        placement_error=ErrorConfig(OFF_MM, OFF_DEG),
    )
    scenario.calibration.maximum_scans = max(scenario.calibration.maximum_scans, MOST_SCANS)
    for file in (part.file, *referenced(part.file)):
        shutil.copyfile(file, folder / file.name)
    return chains


def _with_advice(
    shape: PartShape, path: Path, scenario: Scenario, tool: WeldingTool, tried: int, refused: dict[int, str]
) -> str:
    """Why no seam of a part can be welded, with what its size, a round seam and the planner say of that."""
    spec = scenario.workpiece
    assert spec is not None
    first = spec.seams[0].edges
    _, why = weldable_places(_loaded(path, scenario), advises=True)
    nearest = why.get(0) or refused[first[0]]
    if (
        len(first) > 1
        and (edges := without(first, {id: refused.get(id, nearest) for id in first})).count("Without") > 1
    ):
        nearest = edges.replace("Without edge", "Edge")
    several = f"None of {tried} seams can be welded; the nearest one: " if tried > 1 else ""
    ring = next((joint for joint in shape.joints if list(joint.edges) == first), None)
    least = "" if ring is None or "tool does not fit" not in nearest else least_pipe(shape, ring, tool)
    return f"{unit_hint(shape)} {several}{nearest}{least}".strip()


def add_tool(scenario: Scenario, folder: Path, tool: Path) -> None:
    """Make a file the scenario's tool; one of weldcal's is copied into the cell's folder as tool.yaml."""
    ours = tool.parent == WELDING.parent
    if ours:
        shutil.copyfile(tool, folder / TOOL)
    scenario.tool = ToolFile(TOOL if ours else str(tool.resolve()))
