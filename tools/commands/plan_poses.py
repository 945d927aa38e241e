"""`weldcal plan-poses`: the poses whose scans tell most of camera, scanner and arm together, for `calibrate
--refine`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.planning.calibration_poses import PlannedPose
from weldcal.calibration.planning.observability import turn_deg
from weldcal.calibration.refinement.kinematics_choice import LEAST
from weldcal.calibration.refinement.kinematics_fit import KINDS, informative_poses
from weldcal.models.arms.chain import load_chain
from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.settings import plan_poses as plan_scan_poses
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.files import csv_text, write_json
from weldcal.tools.report.render import write_atomic

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
) -> Outcome:
    """Choose flange poses that the arm reaches and the scanner sees, and write them as a table and URScript. Nothing
    moves."""

    found = plan_refining_poses(
        scenario, call.folder("plan-poses", scenario), scans=scans, kind=kind, seed=call.seed, progress=call.progress
    )
    values = {k: found[k] for k in ("scans", "chosen_from", "written_to")}
    return Outcome(found, values={k.replace("_", " "): v for k, v in values.items()})


def plan_refining_poses(
    scenario: str,
    out: Path,
    *,
    scans: int = 20,
    kind: str = "links",
    seed: int = 0,
    progress: Progress = lambda stage, fraction: None,
) -> dict[str, object]:
    """Choose ``scans`` poses of a scenario's arm before its scanner (at its guess); write poses.csv, poses.script and
    plan.json to ``out``.

    poses.csv is the table of a dataset with the joint angles as planned; replace them by those that the robot reports
    at each scan. Nothing moves. Raises InputError: an unknown ``kind``, fewer scans than `--refine` needs, or a cell in
    which no such poses exist.
    """
    if kind not in KINDS:
        raise InputError(f"There is no refinement '{kind}' of an arm; choose one of {', '.join(KINDS)}.")
    if scans < LEAST:
        raise InputError(f"Errors of the arm need {LEAST} scans and more, not {scans}.")
    loaded = load_scenario(scenario)
    arm = load_chain(loaded.arm, None if loaded.kinematics is None else Path(loaded.kinematics))
    progress("poses", 0.0)
    station = make_station(loaded, seed)
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
    write_atomic(out / "poses.csv", csv_text(names, rows))
    write_atomic(out / "poses.script", "\n".join(["# move to each pose and scan there", *moves]) + "\n")
    write_json(out / "plan.json", result)
    progress("poses", 1.0)
    return result | {"written_to": str(out)}
