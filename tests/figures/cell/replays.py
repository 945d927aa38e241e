"""Records runs of every kind and replays each bit for bit; and measures what recording costs in computing time."""

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy import stats

from tests.figures.harness import Cases, Figures, Results, Row, Study, markdown_table
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.commands.replay import IDENTICAL, replay_recording
from weldcal.tools.commands.run import RECORDING
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.cell.process import X_BC, wired_world
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process
from weldcal.tools.farm.run import Farm
from weldcal.tools.report.demo import DemoResult
from weldcal.tools.report.run import RunOptions

SEAM_MM = 30.0
SHORT = f"welding: {{seam_length_mm: {SEAM_MM}}}"
FEW = "calibration: {minimum_scans: 4, maximum_scans: 6, required_error_mm: 1.0}"
KNOWN = (
    "scanner: !RenderedScanner {preset: phoxi_m, width: 824, height: 616, mounting_translation_mm: 0.0,"
    f" mounting_rotation_deg: 0.0}}\njob: {{calibrate: false, X_BC: {X_BC}}}"
)
HIDDEN = "finger_camera: !RenderedFingerCamera {hidden_from_s: 8.0}"
HOLE_MM = 25.0
Happens = Callable[[], object]


@dataclass(frozen=True)
class Kind:
    """A kind of run: scenario, overrides, robot (simulated, emulated, wired), and a fault as a phase begins."""

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
    """One run of a kind, recorded and replayed; its row. The recording is removed where the replay is identical."""
    made, out = KINDS[kind], Path(folder)
    run = {"simulated": _simulated, "emulated": _emulated, "wired": _wired}[made.robot](made, seed, out)
    summary = run.summary()
    path = out / RECORDING
    size = path.stat().st_size
    found = replay_recording(path).summary()
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


def replay_cases(folder: Path, runs: int, seed: int) -> Cases:
    """``runs`` runs over all kinds in turn, seeds from ``seed`` on, each in a folder of its own."""
    kinds = list(KINDS)
    wanted = [(kinds[k % len(kinds)], seed + k // len(kinds)) for k in range(runs)]
    return {
        f"{kind}, seed {s}": {
            "kind": kind,
            "seed": s,
            "folder": str(folder.absolute() / f"{kind.replace(' ', '_')}_{s}"),
        }
        for kind, s in wanted
    }


def _replays(found: Results) -> Figures:
    same = sum(row.get("replayed") == IDENTICAL for row in found.values())
    state = "done" if same == len(found) else "differs"
    return {"state": state, "runs": len(found), "identical": same, "per_run": found}


def _rows(figures: Figures) -> Iterable[Row]:
    for name, row in figures["per_run"].items():
        ended, replayed = row.get("run", row.get("state", "")), row.get("replayed", row.get("reason", ""))
        size = f"{row.get('size_mb') or 0.0:.0f}"
        yield name, str(ended), str(replayed), f"{row.get('seconds') or 0.0:.1f}", str(row.get("compared", "")), size


REPLAYS = Study(
    name="replay",
    what="Runs of every kind, recorded and replayed bit for bit.",
    case=record_and_replay,
    figures=_replays,
    header=("run", "ended", "replayed", "s", "values compared", "MB"),
    rows=_rows,
    numbers=3,
)


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
            "finger": (
                f"finger_camera: !VideoFingerCamera {{source: 'http://{host}:8081/stream', stamps: host, silent_s:"
                " 2.0}"
            ),
            "scanner": (
                f"scanner: !FolderScanner {{folder: {out / 'world' / 'scans'}, trigger: 'tcp://{host}:5020', "
                "preset: phoxi_m, width: 824, height: 616, scan_timeout_s: 2.0}"
            ),
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


LONGEST_TURN_S = 120.0
ALL_TURNS = 2000  # more than a run takes
_TURNS: list[Semaphore] = []  # of a measuring process: one for each side


def run_overhead(folder: Path, pairs: int, seed: int, progress: Progress) -> tuple[dict[str, object], str]:
    """Run pairs (S groove, 30 mm), one of each recorded; return the JSON object and a table in Markdown.

    Computing time (all threads of a process, s) of whole runs, reports included, is compared. The two runs of a pair
    take turns of one simulated second: a host that works for others too changes its speed by a third within minutes,
    and so changes it for both. A first pair, which compiles and loads, does not count. Each recording is removed.
    `percent_of_a_core`: what recording takes, spread over the run's own seconds.
    """
    rows: list[dict[str, float]] = []
    with _two_processes() as (pool, turns):
        for k in range(pairs + 1):
            progress(f"pair {k} of {pairs}" if k else "first pair, not counted", k / (pairs + 1))
            plain, recorded = _pair(pool, turns, folder / f"pair_{k}", seed)
            if k:
                rows.append(
                    {
                        "pair": float(k),
                        "plain_cpu_s": plain[0],
                        "recorded_cpu_s": recorded[0],
                        "size_mb": recorded[1],
                        "run_s": plain[2],
                    }
                )
    found = overhead(np.array([[row["plain_cpu_s"], row["recorded_cpu_s"]] for row in rows]))
    lines = [
        (f"{row['pair']:.0f}", f"{row['plain_cpu_s']:.2f}", f"{row['recorded_cpu_s']:.2f}", f"{row['size_mb']:.0f}")
        for row in rows
    ]
    text = markdown_table(("pair", "computing s", "recorded, s", "MB"), lines)
    share = 100.0 * float(np.median([(row["recorded_cpu_s"] - row["plain_cpu_s"]) / row["run_s"] for row in rows]))
    text += "recording costs {percent:.1f} % of computing time (median; {low:.1f} to {high:.1f} at 95 %)".format(
        **found
    )
    text += f"; at the pace of a robot that is {share:.1f} % of one core\n"
    return {"state": "done", "overhead": found, "percent_of_a_core": share, "per_pair": rows}, text


def overhead(seconds: np.ndarray) -> dict[str, float]:
    """Compute by how many percent column 2 of (n,2) is longer: median and its interval of at least 95 %.

    A disturbance of the host makes single runs longer: the median and its interval (order statistics) bear that.
    """
    percent = 100.0 * (seconds[:, 1] / seconds[:, 0] - 1.0)
    interval: Any = stats.quantile_test(percent, p=0.5).confidence_interval(0.95)
    return {"percent": float(np.median(percent)), "low": float(interval.low), "high": float(interval.high)}


@contextmanager
def _two_processes() -> Iterator[tuple[ProcessPoolExecutor, list[Semaphore]]]:
    context = get_context("spawn")
    turns = [context.Semaphore(0), context.Semaphore(0)]
    with ProcessPoolExecutor(2, mp_context=context, initializer=_begin, initargs=tuple(turns)) as pool:
        yield pool, turns


def _begin(*turns: Semaphore) -> None:
    _TURNS.extend(turns)


def _pair(
    pool: ProcessPoolExecutor, turns: list[Semaphore], folder: Path, seed: int
) -> list[tuple[float, float, float]]:
    """One run without and one with a recording, in turns."""
    for turn in turns:
        while turn.acquire(block=False):
            pass
    sides = [pool.submit(_in_turns, side, folder / str(side), seed) for side in (0, 1)]
    turns[0].release()
    return [side.result() for side in sides]


def _in_turns(side: int, folder: Path, seed: int) -> tuple[float, float, float]:
    """Run only in its turns; side 1 is recorded. Returns computing time s, recording MB, and the run's s."""
    mine, others = _TURNS[side], _TURNS[1 - side]

    def hand_over(*_: object) -> None:
        others.release()
        mine.acquire(timeout=LONGEST_TURN_S)

    mine.acquire(timeout=LONGEST_TURN_S)
    try:
        return seconds(folder, seed, record=side == 1, progress=hand_over)
    finally:
        for _ in range(ALL_TURNS):
            others.release()


def seconds(folder: Path, seed: int, *, record: bool, progress: Progress) -> tuple[float, float, float]:
    """Computing time s of one run, the size of its recording (MB, 0 without one), and the run's own length s."""
    scenario = load_scenario("s_groove", f"{SHORT}\n{FEW}")
    before = time.process_time()
    result = run_scenario(
        scenario, RunOptions(scenario="s_groove", out=folder, seed=seed, recording=False, record=record), progress
    )
    used, path = time.process_time() - before, folder / RECORDING
    size = path.stat().st_size / 1e6 if record else 0.0
    path.unlink(missing_ok=True)
    return used, size, result.run.seconds


@command(
    "benchmark replay", short_help="Record runs of every kind and replay each bit for bit.", hidden=True, options=FARM
)
def replays(
    call: Call, runs: Annotated[int, option("--runs", "N", "Number of runs, over all kinds in turn.", min=1)] = 20
) -> Outcome:
    """Record runs of every kind (simulated, on an emulated controller, by wire, with faults), and replay each bit for
    bit."""
    folder = call.folder("benchmark", "replay")
    found = REPLAYS.run(Farm.of(folder, call.given, call.progress), replay_cases(folder, runs, call.seed))
    return Outcome(found.figures, text=found.markdown())


@command("benchmark recording", short_help="Measure the computing time that a recording costs.", hidden=True)
def recording(call: Call, pairs: Annotated[int, option("--pairs", "N", "Pairs of runs.", min=6)] = 11) -> Outcome:
    """Run a short demo with and without --record in turn, and compare the computing time."""
    summary, table = run_overhead(call.folder("benchmark", "recording"), pairs, call.seed, call.progress)
    return Outcome(summary, text=table)
