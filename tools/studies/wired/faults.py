"""Every device by wire killed, frozen, delayed by 2 s and sending garbage, in every phase of the job."""

import dataclasses as dc
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.emulators.cell.process import WiredWorld, wired_world
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.output import markdown_table
from weldcal.tools.worlds.robot.wired_job import DEVICES, FAULTS, PHASES, Happening, run_job

SEAM_MM = 20.0
COLUMNS = (
    "device", "fault", "phase", "state", "reason", "torch_off_after_s", "rest_after_s", "named_after_s", "moved", "arc_s", "wall_s", "problems",
)  # fmt: skip
TIMES = ("torch_off_after_s", "rest_after_s", "named_after_s")


def one_world(device: str, phase: str, seed: int, folder: str) -> Mapping[str, object]:
    """Every fault of a device in a phase, one job each, in one world: rows of COLUMNS."""
    host = f"127.{40 + DEVICES.index(device)}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    with wired_world(Path(folder) / "world", host, seed, SEAM_MM, bridged=True) as world:
        return {"rows": [_row(world, Path(folder), seed, Happening(device, fault, phase)) for fault in FAULTS]}


def _row(world: WiredWorld, folder: Path, seed: int, happening: Happening) -> dict[str, object]:
    calibrates = happening.phase == "calibrate"
    try:
        return run_job(world, folder / happening.fault, seed, calibrates=calibrates, happening=happening)
    except WeldcalError as problem:  # the job did not begin: what the fault before it has left
        return dict.fromkeys(COLUMNS, "") | dc.asdict(happening) | {"state": "failed", "problems": [str(problem)]}


def run_wired_faults(
    farm: Farm, seed: int, devices: Sequence[str] = (), phases: Sequence[str] = ()
) -> tuple[dict[str, object], str]:
    """The matrix, or some devices and phases of it: the JSON object, and a table. Writes faults.csv after each world.

    Raises:
        InputError: there is no such device or phase.
    """
    for given, known in ((devices, DEVICES), (phases, tuple(PHASES))):
        if unknown := [name for name in given if name not in known]:
            raise InputError(f"There is no '{unknown[0]}' here: choose of {', '.join(known)}.")
    tasks = {
        f"{device}, {phase}": {
            "device": device,
            "phase": phase,
            "seed": seed,
            "folder": str(farm.folder.absolute() / f"{device}_{phase}".replace(" ", "_")),
        }
        for device in devices or DEVICES
        for phase in phases or PHASES
    }

    def table(found: dict[str, Result]) -> None:
        write_atomic(
            farm.folder / "faults.csv", csv_text(COLUMNS, ([r.get(n, "") for n in COLUMNS] for r in _rows(found)))
        )

    found = farm.run(one_world, tasks, table)
    rows = _rows(found)
    wrong = [f"{r['device']} {r['fault']} in {r['phase']}: {'; '.join(r['problems'])}" for r in rows if r["problems"]]
    wrong += [f"{name}: {result['reason']}" for name, result in found.items() if "rows" not in result]
    summary: dict[str, object] = {
        "state": "failed" if wrong else "done", "faults": len(rows), "held_by_name": sum(r["state"] == "held" for r in rows),
        "done_while_silent": sum(r["state"] == "done" for r in rows), "wrong": wrong, "rows": rows,
        **({"reason": wrong[0]} if wrong else {}),
    }  # fmt: skip
    cells = [(str(r["device"]), str(r["fault"]), str(r["phase"]), str(r["state"]), *(_seconds(r[name]) for name in TIMES),
              "; ".join(r["problems"]) or "as required", str(r["reason"])) for r in rows]  # fmt: skip
    titles = ("device", "fault", "phase", "job", "torch off s", "arm at rest s", "named s", "verdict", "reason")
    return summary, markdown_table(titles, cells)


def _seconds(value: object) -> str:
    return "" if value in (None, "") else f"{float(str(value)):.2f}"


def _rows(found: dict[str, Result]) -> list[Result]:
    return [row for result in found.values() for row in result.get("rows", ())]
