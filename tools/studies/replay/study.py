"""Records runs of every kind (simulated, on an emulated controller, by wire, with faults) and replays each bit for bit."""

import os
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.demo import run_scenario
from weldcal.tools.commands.record import RECORDING
from weldcal.tools.commands.replay import IDENTICAL, replay
from weldcal.tools.emulators.cell.process import X_BC, wired_world
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.outcomes.demo import DemoResult
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.files import csv_text
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.output import markdown_table

COLUMNS = ("kind", "seed", "run", "reason", "replayed", "first", "seconds", "compared", "size_mb")
SEAM_MM = 30.0
SHORT = f"welding: {{seam_length_mm: {SEAM_MM}}}"
FEW = "calibration: {minimum_scans: 4, maximum_scans: 6, required_error_mm: 1.0}"
KNOWN = (
    "scanner: !RenderedScanner {preset: phoxi_m, width: 824, height: 616, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}\n"
    f"job: {{calibrate: false, X_BC: {X_BC}}}"
)
HIDDEN = "finger_camera: !RenderedFingerCamera {hidden_from_s: 8.0}"
HOLE_MM = 25.0
Happens = Callable[[], object]


@dataclass(frozen=True)
class Kind:
    """A kind of run: scenario, overrides, the robot (simulated, emulated or wired), and a fault at the begin of a phase."""

    scenario: str
    overrides: str
    robot: str = "simulated"
    fault: str = ""
    phase: str = ""


KINDS = {
    "whole job": Kind("s_groove", f"{SHORT}\n{FEW}"),
    "weld": Kind("l_groove", f"{SHORT}\n{KNOWN}"),
    "calibration on a controller": Kind("s_groove", f"{FEW}\njob: {{weld: false}}", "emulated"),
    "weld on a controller": Kind("straight_groove", f"{SHORT}\n{KNOWN}", "emulated"),
    "weld by wire": Kind("", "", "wired"),
    "the tag is hidden": Kind("straight_groove", f"welding: {{seam_length_mm: 60.0}}\n{KNOWN}\n{HIDDEN}"),
    "contact is lost": Kind("straight_groove", f"welding: {{seam_length_mm: 80.0}}\n{KNOWN}", fault="hole"),
    "protective stop": Kind("straight_groove", f"{SHORT}\n{KNOWN}", "emulated", "protective_stop", "approach_above"),
    "pictures stop": Kind("", "", "wired", "finger", "start"),
    "the scanner stops": Kind("", "", "wired", "scanner", "scan_workpiece"),
}


def record_and_replay(kind: str, seed: int, folder: str) -> Mapping[str, object]:
    """One run of a kind, recorded and replayed; a row of COLUMNS. The recording is removed where the replay is identical."""
    made, out = KINDS[kind], Path(folder)
    run = {"simulated": _simulated, "emulated": _emulated, "wired": _wired}[made.robot](made, seed, out)
    summary = run.summary()
    path = out / RECORDING
    size = path.stat().st_size
    found = replay(path).summary()
    if found["state"] == IDENTICAL:
        path.unlink()
    return {
        "kind": kind,
        "seed": seed,
        "run": summary["state"],
        "reason": summary.get("reason", ""),
        "replayed": found["state"],
        "first": found.get("first", ""),
        "seconds": found["seconds"],
        "compared": found["compared"],
        "size_mb": size / 1e6,
    }


def run_replays(farm: Farm, runs: int, seed: int) -> tuple[dict[str, object], str]:
    """``runs`` runs over all kinds in turn, seeds from ``seed`` on: the JSON object, and a table in Markdown."""
    kinds = list(KINDS)
    tasks = {}
    for k in range(runs):
        kind, s = kinds[k % len(kinds)], seed + k // len(kinds)
        folder = farm.folder.absolute() / f"{kind.replace(' ', '_')}_{s}"
        tasks[f"{kind}, seed {s}"] = {"kind": kind, "seed": s, "folder": str(folder)}

    def table(found: dict[str, Result]) -> None:
        text = csv_text(COLUMNS, ([row.get(name, "") for name in COLUMNS] for row in found.values()))
        write_atomic(farm.folder / "replays.csv", text)

    found = farm.run(record_and_replay, tasks, table)
    same = sum(row.get("replayed") == IDENTICAL for row in found.values())
    rows = [
        (name, str(row.get("run", row.get("state", ""))), str(row.get("replayed", row.get("reason", ""))),
         f"{row.get('seconds') or 0.0:.1f}", str(row.get("compared", "")), f"{row.get('size_mb') or 0.0:.0f}")
        for name, row in found.items()
    ]  # fmt: skip
    header = ("run", "ended", "replayed", "s", "values compared", "MB")
    state = "done" if same == len(found) else "differs"
    return {"state": state, "runs": len(found), "identical": same, "per_run": found}, markdown_table(header, rows)


def _simulated(kind: Kind, seed: int, out: Path) -> DemoResult:
    scenario = load_scenario(kind.scenario, kind.overrides)
    if kind.fault == "hole" and scenario.workpiece is not None:
        scenario.workpiece.hole_from_mm = HOLE_MM
    return _run(scenario, RunOptions(scenario=kind.scenario, out=out, seed=seed, recording=False, record=True))


def _emulated(kind: Kind, seed: int, out: Path) -> DemoResult:
    scenario = load_scenario(kind.scenario, kind.overrides)
    with emulator_process(q=np.deg2rad(scenario.home_deg).tolist(), lockstep=LOCKSTEP_S) as controller:
        options = RunOptions(
            scenario=kind.scenario, out=out, seed=seed, robot=controller.host, pace=1.0, recording=False, record=True
        )
        return _run(scenario, options, kind.phase, lambda: _fault(controller, kind.fault))


def _wired(kind: Kind, seed: int, out: Path) -> DemoResult:
    # An address of its own for each run that goes on at the same time.
    host = f"127.{35 + list(KINDS.values()).index(kind)}.{seed % 250}.{1 + os.getpid() % 250}"
    with wired_world(out / "world", host, seed, SEAM_MM) as world:
        stopped = {"finger": world.finger, "scanner": world.scanner}.get(kind.fault)
        quick = {
            "finger": f"finger_camera: !VideoFingerCamera {{source: 'http://{host}:8081/stream', stamps: host, silent_s: 2.0}}",
            "scanner": f"scanner: !FolderScanner {{folder: {out / 'world' / 'scans'}, trigger: 'tcp://{host}:5020', "
            "preset: phoxi_m, width: 824, height: 616, scan_timeout_s: 2.0}",
        }.get(kind.fault, "")
        options = RunOptions(scenario=str(world.cell), out=out, seed=seed, recording=False, record=True)
        return _run(
            load_scenario(str(world.cell), quick),
            options,
            kind.phase,
            lambda: None if stopped is None else os.kill(stopped, signal.SIGSTOP),
        )


def _run(scenario: Scenario, options: RunOptions, phase: str = "", happens: Happens = lambda: None) -> DemoResult:
    """Run a job; ``happens`` is called when a phase begins for the first time."""
    seen: list[str] = []

    def watch(stage: str, _: float) -> None:
        if phase and stage == phase_words(phase) and not seen:
            seen.append(stage)
            happens()

    progress: Progress = watch
    return run_scenario(scenario, options, progress)


def _fault(controller: Emulator, name: str) -> None:
    if name:
        controller.fault(name)
