"""weldcal plan-poses and plan-passes: the scans that determine most, and the beads that fill a joint."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_choice import LEAST
from weldcal.calibration.refinement.kinematics_fit import KINDS, informative_poses
from weldcal.models.arms.kinematics import ArmModel, mounted
from weldcal.models.arms.shape import TUBE_M, arm_capsules
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic
from weldcal.models.robots import get_chain
from weldcal.models.workpieces.part import numbered, seam_count
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.jobs.weld.settings import plan_poses as plan_scan_poses
from weldcal.systems.motion.clear_moves import BareArm
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import part_of, surroundings_of
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station, make_station
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import csv_text, write_json
from weldcal.welding.passes.bead import WIDEST_M, bead_area, filling_passes

_POOL = (6, 4, 3, 2, 1)
"""Times the scans: how many poses to choose from, as many as the cell allows."""


@command("plan-poses", short_help="Find the poses of scans for calibrate --refine.")
def plan_poses(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="Arm, scanner and its guess: a scenario by name or YAML file.")
    ] = "calibrate_only",
    scans: Annotated[int, option("--scans", "N", "Number of scans.", min=12)] = 20,
    kind: Annotated[str, option("--kind", "KIND", "The refinement that they are for: links or joints.")] = "links",
    robot: Annotated[
        str | None, option("--robot", "NAME", "Another arm than the scenario's, for example my_arm.urdf.")
    ] = None,
) -> Outcome:
    """Choose flange poses that the arm reaches and the scanner sees, and write them as a table and URScript. Nothing
    moves."""

    found = plan_refining_poses(
        scenario,
        call.folder("plan-poses", scenario),
        scans=scans,
        kind=kind,
        robot=robot,
        seed=call.seed,
        progress=call.progress,
    )
    values = {k: found[k] for k in ("scans", "chosen_from", "bodies", "written_to") if k in found}
    return Outcome(found, values={k.replace("_", " "): v for k, v in values.items()})


def plan_refining_poses(
    scenario: str,
    out: Path,
    *,
    scans: int = 20,
    kind: str = "links",
    robot: str | None = None,
    seed: int = 0,
    progress: Progress = lambda stage, fraction: None,
) -> dict[str, object]:
    """Choose ``scans`` poses before a scenario's scanner; write poses.csv, poses.script and plan.json to ``out``.

    ``poses.csv`` is the table of a dataset with the joint angles as planned; replace them by those that the robot
    reports at each scan. ``robot`` is another arm than the scenario's, by name or URDF: then no script is written.
    Nothing moves. Raises InputError: an unknown ``kind``, fewer scans than `--refine` needs, or a cell in which no such
    poses exist.
    """
    if kind not in KINDS:
        raise InputError(f"There is no refinement '{kind}' of an arm; choose one of {', '.join(KINDS)}.")
    if scans < LEAST:
        raise InputError(f"Errors of the arm need {LEAST} scans and more, not {scans}.")
    loaded = load_scenario(scenario)
    progress("poses", 0.0)
    station = make_station(loaded, seed) if robot is None else _bare(loaded, robot)
    arm = station.arm
    pool: tuple[PlannedPose, ...] = ()
    try:
        for k, times in enumerate(_POOL):
            try:
                pool = plan_scan_poses(loaded, station, seed, count=times * scans)
                break
            except UnreachableScanner:
                if times == _POOL[-1]:
                    raise
                progress("poses", (k + 1) / (len(_POOL) + 1))
    finally:
        if isinstance(station, Station):
            station.close()
    q = np.array([p.q for p in pool])
    chosen = [pool[i] for i in informative_poses(arm, loaded.calibration.mounting_guess.pose(), q, scans, kind)]
    rows = []
    for i, p in enumerate(chosen, start=1):
        w = p.X_BF.rotation().ToQuaternion().wxyz()
        rows.append([f"pose{i:02d}", *(f"{v:.6f}" for v in (*p.X_BF.translation(), *w, *p.q))])
    names = ("id", "x", "y", "z", "qw", "qx", "qy", "qz", *(f"q{j + 1}" for j in range(arm.n)))
    moves = [
        f"movej([{', '.join(f'{v:.6f}' for v in p.q)}], a=1.2, v=0.4)  # {r[0]}: scan"
        for p, r in zip(chosen, rows, strict=True)
    ]
    result: dict[str, object] = {
        "state": "done",
        "kind": kind,
        "scans": len(chosen),
        "chosen_from": len(pool),
        "turn_deg": turn_deg([p.X_BF for p in chosen]),
        "joints_deg": [[round(float(v), 3) for v in np.degrees(p.q)] for p in chosen],
    }
    if arm.file is not None and all(c.radius == TUBE_M for c in arm_capsules(arm)):
        result["bodies"] = f"{arm.name} has no shapes: its links are tubes of {2e3 * TUBE_M:.0f} mm between the joints."
    write_atomic(out / "poses.csv", csv_text(names, rows))
    if isinstance(arm, ArmModel):
        write_atomic(out / "poses.script", "\n".join(["# move to each pose and scan there", *moves]) + "\n")
    write_json(out / "plan.json", result)
    progress("poses", 1.0)
    return result | {"written_to": str(out)}


def _bare(scenario: Scenario, robot: str) -> BareArm:
    """Return a known arm, or that of a URDF, on the scenario's base with its tool and surroundings."""
    loaded = scenario.loaded_tool()
    arm = mounted(get_chain(robot), scenario.base.pose())
    return BareArm(arm, None if loaded is None else loaded.tool, surroundings_of(scenario))


@command("plan-passes", short_help="Propose the passes that fill a joint.")
def plan_passes(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="Joint, speed and wire feed: a scenario by name or YAML file.")
    ],
    depth_mm: Annotated[
        float | None,
        option("--depth-mm", "MM", "Filled up to this height over the root.", show_default="a groove's depth"),
    ] = None,
    wire_feed_m_min: Annotated[
        float | None, option("--wire-feed-m-min", "M", "Of all passes.", min=0.1, show_default="the scenario's")
    ] = None,
    wire_mm: Annotated[float, option("--wire-mm", "MM", "Diameter of the wire.", min=0.5, max=4.0)] = 1.2,
    widest_mm: Annotated[float, option("--widest-mm", "MM", "Widest bead.", min=2.0)] = 1e3 * WIDEST_M,
    seam: Annotated[int, option("--seam", "N", "Number of the seam.", min=1)] = 1,
) -> Outcome:
    """Compute the beads of a wire feed and a speed, and print the passes after the root as lines for the scenario.

    The metal is counted without loss, and the surface is level. The speed of the passes makes the joint exactly full.
    """
    loaded = load_scenario(scenario)
    half, depth_m = _joint(loaded, seam, depth_mm)
    speed_m_s = 1e-3 * loaded.welding.speed_mm_s
    feed_m_s = _feed(loaded, wire_feed_m_min) / 60.0
    area = bead_area(feed_m_s, 1e-3 * wire_mm, speed_m_s)
    passes, filling = filling_passes(area, area, half, depth_m, 1e-3 * widest_mm)
    rows = [
        {
            "lateral_mm": round(1e3 * p.lateral_m, 2),
            "vertical_mm": round(1e3 * p.vertical_m, 2),
            "speed_mm_s": round(1e3 * speed_m_s * area / filling, 2),
        }
        for p in passes
    ]
    joint_mm2, beads_mm2 = 1e6 * math.tan(half) * depth_m**2, 1e6 * (area + len(passes) * filling)
    words = f"{2.0 * math.degrees(half):.0f} deg between the walls, {1e3 * depth_m:.1f} mm deep: {joint_mm2:.1f} mm2"
    lines = [
        f"# {words}",
        f"# root of {1e6 * area:.1f} mm2, passes of {1e6 * filling:.1f} mm2",
        "welding:",
        "  passes:" if rows else "  passes: []  # the root fills it",
        *(f"  - {{{', '.join(f'{key}: {value:g}' for key, value in row.items())}}}" for row in rows),
    ]
    found = {"state": "done", "passes": rows, "joint_mm2": joint_mm2, "beads_mm2": beads_mm2}
    return Outcome(found, text="\n".join(lines))


def _joint(scenario: Scenario, number: int, depth_mm: float | None) -> tuple[float, float]:
    """Half of the angle between the walls, rad, and how high over the root they are filled, m; raises InputError."""
    spec = scenario.workpiece
    if spec is None:
        raise InputError("The scenario has no workpiece, and so no joint to fill: write workpiece.")
    part = make_workpiece(spec.shape, length_m=1e-3 * spec.length_mm) if spec.file is None else part_of(spec)
    if number > seam_count(part):
        raise InputError(f"--seam is {number}, and the part has {seam_count(part)} seams.")
    drawn = numbered(part, number - 1)
    if not 0.0 < drawn.half_angle_rad < 0.5 * math.pi - 1e-3:
        raise InputError("The joint of this seam has no walls with an angle between them: passes fill a V or a fillet.")
    if depth_mm is None and spec.joint not in (None, "v_groove"):
        raise InputError(f"A {spec.joint} is filled up to its throat: give it by --depth-mm.")
    if depth_mm is not None and not (np.isfinite(depth_mm) and 0.0 < depth_mm <= 1e3 * drawn.depth_m + 1e-6):
        raise InputError(f"--depth-mm must be above 0 and at most {1e3 * drawn.depth_m:.1f}, the height of the walls.")
    return drawn.half_angle_rad, drawn.depth_m if depth_mm is None else 1e-3 * depth_mm


def _feed(scenario: Scenario, given: float | None) -> float:
    """The wire feed m/min; raises InputError where it is not known."""
    welding = scenario.welding
    scheduled = None if welding.schedule is None else welding.schedule.wire_feed_m_min
    feed = next((f for f in (given, scheduled, welding.process.wire_feed_m_min) if f is not None), math.nan)
    if not feed > 0.0:
        raise InputError(
            "The wire feed is not known: give --wire-feed-m-min, or write welding.process.wire_feed_m_min."
        )
    return feed
