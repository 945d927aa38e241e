"""Breaks short welds off at random places, goes on with each, and judges the join by the simulation's truth.

python -m tests.restarted [TIMES] [SEED] [KINDS]     prints one line for each stop, and the counts

python -m tests.restarted record [TIMES] [SEED] [KINDS]     with weave and tack, in one pass and in two: compares the
record with where the simulation's arc burned, and prints one line for each interruption, and the count
"""

from __future__ import annotations

import csv
import html
import json
import math
import mmap
import os
import re
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from tests.held_weld import SHORT_WELD, short_weld
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.jobs.weld.progress_keeper import ProgressKeeper
from weldcal.systems.operator import Operator
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands import run as commands_run
from weldcal.tools.commands.weld import broken_weld, keeper_of, killed_weld, restarting, run_scenario
from weldcal.tools.console import plain
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import weld_outcome
from weldcal.welding.record.progress import Progress, load_progress
from weldcal.welding.seam.curve import SeamCurve

SIMULATED, WIRED = ("pause", "end", "power"), ("protective", "killed")
"""How a weld breaks off. Pause: an operator holds it and lets it go on. End: an operator ends it. Power: the process is
killed, and the robot with it. Protective: the emulated controller stops. Killed: the process is, and that stays."""
ACROSS_MM, ALONG_MM = 0.3, 1.0
OVERLAP_M, PAUSE_OVERLAP_M = 8e-3, 5e-3
NEAR_M = 8e-3
PACE = 0.3  # of the emulated controller: on a loaded computer the camera's pictures were too late at 1
FIRST_M, LAST_M = 0.5e-3, 23.5e-3  # of the 24 mm seam


@dataclass(frozen=True, kw_only=True)
class Join:
    """Of one broken weld: true torch (3,) m where the arc went out, what was asked, and errors at the join, mm.

    `unasked`: arcs of the second run that were lit before an operator's yes.
    """

    crater_mm: float
    across_mm: float
    along_mm: float
    unasked: int
    reason: str | None


class Torch:
    """The true torch and its arc, in memory that outlives the process: (3,) m where it burned last."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, 32)

    def look(self, cell: Cell[Any], root: Any) -> bool:
        """Take the state of a tick; returns whether the arc burns."""
        context = cell.diagram.GetMyContextFromRoot(root)
        on = bool(cell.diagram.GetOutputPort("process_on").Eval(context)[0] > 0.5)
        if on:
            self._memory[:24] = struct.pack("3d", *cell.diagram.GetOutputPort("torch").Eval(context)[:3])
        return on

    @property
    def p_B(self) -> np.ndarray:
        """Where it burned last."""
        return np.array(struct.unpack("3d", self._memory[:24]))


def weld_until(
    scenario: Scenario, seed: int, at_m: float, kind: str, folder: Path, torch: Torch, emulator: Emulator | None
) -> None:
    """Weld and break off where the torch has come to `at_m`; a kill does not return."""
    operator = Operator()
    cell = build_cell(scenario, seed, operator=operator)
    keeper = keeper_of(scenario, RunOptions(scenario="short", out=folder, seed=seed))
    assert keeper is not None
    stopped = False

    def look(run: Any) -> None:
        nonlocal stopped
        keeper.look(run)
        on, state = torch.look(cell, run.root), cell.job.servo_report(run.root).state
        if not on or stopped or state is None or state.s_torch < at_m:
            return
        stopped = True
        if kind in ("power", "killed"):
            os.kill(os.getpid(), signal.SIGKILL)
        elif kind == "protective":
            assert emulator is not None
            emulator.fault("protective_stop")
        else:
            operator.end()

    run = run_cell(cell, look=look)
    keeper.close(run)
    if not stopped:
        print(f"not broken off: {run.reason}")


def go_on(scenario: Scenario, seed: int, progress: Progress, folder: Path, torch: Torch) -> Join:
    """Go on with a broken weld, with another noise of scanner, camera and arm, and judge the join."""
    operator, arcs = Operator(), 0
    cell = build_cell(scenario, seed, operator=operator, replace=restarting(progress.restart(OVERLAP_M)))
    for system in cell.station.diagram.GetSystems():
        if hasattr(system, "_seed"):
            system._seed += 1000
    keeper = keeper_of(scenario, RunOptions(scenario="short", out=folder, seed=seed), progress)
    assert keeper is not None
    crater, before = torch.p_B, Torch()

    def look(run: Any) -> None:
        nonlocal arcs
        keeper.look(run)
        arcs += before.look(cell, run.root) and not operator.answered

    def answer() -> None:
        while not operator.stands:
            time.sleep(0.01)
        time.sleep(0.2)
        operator.go_on()

    threading.Thread(target=answer, daemon=True).start()
    run = run_cell(cell, look=look)
    keeper.close(run)
    found = weld_outcome(cell, run.root)
    if found is None or found.error is None or found.true_seam is None:
        return Join(crater_mm=np.nan, across_mm=np.inf, along_mm=np.inf, unasked=arcs, reason=run.reason)
    at = float(found.true_seam.project(crater))
    near = np.abs(found.error.s - at) < NEAR_M
    ordered = max(at - OVERLAP_M, 0.0)
    return Join(
        crater_mm=1e3 * at,
        across_mm=1e3 * float(found.error.distance_m[near].max()),
        along_mm=1e3 * (float(found.error.s.min()) - ordered),
        unasked=arcs,
        reason=run.reason,
    )


def pause(scenario: Scenario, seed: int, at_m: float) -> Join:
    """An operator holds a weld and lets it go on, in one run."""
    operator = Operator()
    cell = build_cell(scenario, seed, operator=operator)
    begun, held = False, threading.Event()

    def look(run: Any) -> None:
        nonlocal begun
        state = cell.job.servo_report(run.root).state
        if not begun and state is not None and state.torch_on and state.s_torch > at_m:
            begun = True
            operator.hold("a test")
            held.set()

    def let_go() -> None:
        held.wait()
        while not operator.stands:
            time.sleep(0.005)
        operator.go_on()

    threading.Thread(target=let_go, daemon=True).start()
    run = run_cell(cell, look=look)
    error = weld_outcome(cell, run.root).error  # type: ignore[union-attr]
    assert error is not None
    k = int(np.argmin(np.diff(error.s)))
    near = np.abs(error.s - error.s[k]) < NEAR_M
    ordered = max(error.s[k] - PAUSE_OVERLAP_M, error.s[0])
    return Join(
        crater_mm=1e3 * float(error.s[k]),
        across_mm=1e3 * float(error.distance_m[near].max()),
        along_mm=1e3 * float(error.s[k + 1] - ordered),
        unasked=0,
        reason=run.reason,
    )


def apart(work: Callable[[], Any]) -> tuple[int, Any]:
    """Do a piece of work in a process of its own; returns its exit status and what it returned."""
    import pickle

    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.close(reader)
            os.write(writer, pickle.dumps(work()))
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        data = pipe.read()
    _, status = os.waitpid(child, 0)
    return status, pickle.loads(data) if data else None


def one(kind: str, at_m: float, seed: int, place: Path) -> Join | None:
    """Break a weld off and go on with it; None where the second run failed."""
    if kind == "pause":
        paused: Join | None = apart(lambda: pause(short_weld(), seed, at_m))[1]
        return paused
    torch = Torch()
    with ExitStack() as stack:
        emulator: Emulator | None = None

        def scenario() -> Scenario:
            found = short_weld()
            if emulator is not None:
                found.robot = UrRtde(host=emulator.host, lockstep=True, process_output=3, pace=PACE)
            return found

        if kind in WIRED:
            q = np.deg2rad(short_weld().home_deg).tolist()
            emulator = stack.enter_context(emulator_process(q=q, lockstep=LOCKSTEP_S, pace=PACE))
        status, _ = apart(lambda: weld_until(scenario(), seed, at_m, kind, place / "1", torch, emulator))
        if kind in ("power", "killed") and status != signal.SIGKILL:
            return None
        progress = load_progress(place / "1")
        if kind in WIRED:  # the operator frees the arm, and moves it home by the pendant
            stack.close()
            emulator = stack.enter_context(emulator_process(q=q, lockstep=LOCKSTEP_S, pace=PACE))
        found: Join | None = apart(lambda: go_on(scenario(), seed, progress, place / "1", torch))[1]
        return found


RECORD_KINDS = ("sigint", "kill", "power", "pause")
"""Kill: the process is killed. Power: so is it, its last line is torn, and the computer has started again since."""
SEAM_MM, UNION_MM = 45.0, 0.5
ORDER = (
    "speed_mm_s: 16.0, weave: {shape: sine, amplitude_mm: 1.0, frequency_hz: 2.0},"
    " tacks: [{from_mm: 20, to_mm: 26, height_mm: 5.5}], order: {part: P-1, operator: jd}"
)
SECOND_PASS = ", passes: [{lateral_mm: 1.0, vertical_mm: 4.0, reverse: true}]"
PLAN = "plan.npy"
_TICK = struct.Struct("iid3d")


def ordered_weld(passes: int) -> Scenario:
    """A seam with a weave and a tack, in one pass or in two."""
    welding = f"welding: {{seam_length_mm: {SEAM_MM}, {ORDER}{SECOND_PASS if passes > 1 else ''}}}\n"
    return load_scenario("straight_groove", SHORT_WELD.partition("welding:")[0] + welding)


def logged_run(
    scenario: Scenario, folder: Path, seed: int, run: int, kind: str = "", at: tuple[int, float] = (0, 0.0), **more: Any
) -> dict[str, Any]:
    """Run a weld as the command does, and break it off in a pass (from 0) at a place, m; returns its JSON object.

    Where the true torch was while the arc burned is added to a file that outlives the process.
    """
    operator, begun = Operator(), False
    keeper_look = ProgressKeeper.look

    def look(keeper: ProgressKeeper, now: Any) -> None:
        nonlocal begun
        keeper_look(keeper, now)
        context = now.cell.diagram.GetMyContextFromRoot(now.root)
        if now.cell.diagram.GetOutputPort("process_on").Eval(context)[0] < 0.5:
            return
        torch = now.cell.diagram.GetOutputPort("torch").Eval(context)[:3]
        if not (folder.parent / PLAN).exists():
            line = now.cell.job.planned_seam(now.root).records[0].line
            np.save(folder.parent / PLAN, line.position(np.linspace(0.0, line.length, 200)))
        with (folder.parent / "truth.bin").open("ab") as file:
            file.write(_TICK.pack(run, now.command.weld_pass, now.seconds, *torch))
        state = now.cell.job.servo_report(now.root).state
        if begun or not kind or now.command.weld_pass != at[0] or state is None or state.s_torch < at[1]:
            return
        begun = True
        if kind == "pause":
            operator.hold("a test")
        elif kind == "sigint":
            signal.raise_signal(signal.SIGINT)
        else:
            os.kill(os.getpid(), signal.SIGKILL)

    def answers() -> None:
        while True:
            time.sleep(0.02)
            if operator.stands:
                operator.go_on()

    @contextmanager
    def operator_at() -> Iterator[Operator]:
        yield operator

    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=answers, daemon=True).start()
    with patch.object(ProgressKeeper, "look", look), patch.object(commands_run, "operator_at", operator_at):
        earlier = more.pop("earlier", None)
        options = RunOptions(scenario="ordered", out=folder, seed=seed, recording=False, **more)
        result = run_scenario(scenario, options, earlier=earlier)
    return json.loads(json.dumps(plain({"first_screen": result.first.document(), **result.summary()})))  # type: ignore[no-any-return]


def burned(folder: Path, passes: int) -> list[list[tuple[float, float]]]:
    """Where the true arc burned in each pass, mm: from and to of each piece, joined where they meet.

    Places are those along the first run's plan, for a scan does not locate the start of a groove to 0.5 mm.
    """
    seam = SeamCurve.from_points(np.load(folder.parent / PLAN))
    ticks = list(_TICK.iter_unpack((folder.parent / "truth.bin").read_bytes()))
    found = []
    for number in range(passes):
        pieces, last = [], (-1, -1.0)
        for run, weld_pass, at, *p in ticks:
            if weld_pass == number:
                s = 1e3 * float(seam.project(np.array(p)))
                if run != last[0] or at - last[1] > 0.05:
                    pieces.append((s, s))
                pieces[-1] = (min(pieces[-1][0], s), max(pieces[-1][1], s))
                last = (run, at)
        found.append(merged(pieces))
    return found


def merged(pieces: Iterable[Sequence[float]]) -> list[tuple[float, float]]:
    """The union of pieces (from, to), in rising order."""
    found: list[tuple[float, float]] = []
    for a, b in sorted((min(p), max(p)) for p in pieces):
        if found and a <= found[-1][1] + 0.3:
            found[-1] = (found[-1][0], max(found[-1][1], b))
        else:
            found.append((a, b))
    return found


def disagreements(folder: Path, result: dict[str, Any] | None) -> list[str]:
    """Where the files of a record, its page, the report and the JSON object of the command do not agree."""
    record, page = json.loads((folder / "record.json").read_text()), (folder / "record.html").read_text()
    with (folder / "record.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    page, wrong = html.unescape(page), []
    shown = [(seam["seam"], seam["weld_pass"], seam["arc_mm"]) for seam in record["seams"]]
    in_table = [
        (int(r["seam"]), int(r["pass"]), [[float(v) for v in p.split("-")] for p in r["arc_mm"].split()]) for r in rows
    ]
    if [(a, b, np.round(c, 1).tolist()) for a, b, c in shown] != in_table:
        wrong.append(f"record.csv: {in_table}, record.json: {shown}")
    pages = {"record.html": page}
    if result is not None:
        pages["report.html"] = html.unescape((folder / "report.html").read_text())
        if result["arc_mm"] != [c for _, _, c in shown] or result["pieces"] != record["pieces"]:
            wrong.append("--json has other pieces")
        if abs(result["welded_mm"] - record["welded_mm"]) > 1e-9:
            wrong.append("--json has another length")
    for name, text in pages.items():
        cells = re.findall(r"<td[^>]*>([^<]*)</td>", text)
        for piece in record["pieces"]:
            row = [f"{piece['from_mm']:.1f}".replace("-", "\u2212"), f"{piece['to_mm']:.1f}".replace("-", "\u2212")]
            texts = [cell.strip().replace("-", "\u2212") for cell in cells]
            if not any(texts[k : k + 2] == row for k in range(len(texts))):
                wrong.append(f"{name} has no row {row}")
    for sentence in record["broke_off"]:
        wrong += [f"{name} does not say: {sentence}" for name, text in pages.items() if sentence not in text]
        if result is not None and sentence not in result["warnings"]:
            wrong.append(f"--json does not say: {sentence}")
    if result is not None and record["broke_off"] and not result["first_screen"]["could_be_wrong"]:
        wrong.append("the terminal says that nothing was found")
    return wrong


ENDED = {"sigint": "Ctrl-C", "kill": "killed", "power": "power was lost", "pause": "held by an operator (a test)"}


def recorded(kind: str, passes: int, at: tuple[int, float], seed: int, place: Path) -> tuple[float, list[str]]:
    """Break a weld off, go on with it where that is possible, and judge its record; the worst end in mm, and faults."""
    folder, wrong, went_on = place / "weld", [], passes == 1 or kind == "pause"
    status, result = apart(lambda: logged_run(ordered_weld(passes), folder, seed, 1, kind, at))
    if kind in ("kill", "power"):
        if status != signal.SIGKILL:
            return math.inf, ["it was not broken off"]
        if kind == "power":
            with (folder / "craters.jsonl").open("ab") as file:
                file.write(b"[0, 0, 0, 0.0")
        _, said = apart(lambda: after_power(kind == "power", lambda: killed_weld(folder)))
        advice = "weld the rest by hand" if passes > 1 else f"Go on with weldcal weld --resume {folder}"
        if said is not None and "Before its first arc" in said and not (folder / "record.json").exists():
            off = max(b - a for pieces in burned(folder, passes) for a, b in pieces)
            return off, [] if off < UNION_MM else ["it lost an arc"]  # power was lost while the arc was lit
        if said is None or ENDED[kind] not in said or advice not in said or "mm of seam 1" not in said:
            wrong.append(f"view says: {said}")
    if kind != "pause" and passes == 1:

        def again() -> dict[str, Any]:
            broken = broken_weld(folder, 1e3 * OVERLAP_M, {"browser": True})
            return logged_run(
                broken.scenario, folder, seed, 2, replace=broken.options["replace"], earlier=broken.progress
            )

        _, result = apart(lambda: after_power(kind == "power", again))
        if result is None or result["state"] != "done":
            reason = str((result or {}).get("reason"))
            went_on, result = False, None
            wrong += [] if "weld it by hand" in reason else [f"it did not go on: {reason}"]
    if not (folder / "record.json").exists():
        return math.inf, [*wrong, "there is no record"]
    record = json.loads((folder / "record.json").read_text())
    wrong += disagreements(folder, result)
    cut = [piece for piece in record["pieces"] if piece["ended"] != "done"]
    if [ENDED[kind] in piece["ended"] for piece in cut] != [True] or len(record["broke_off"]) != 1:
        wrong.append(f"pieces: {record['pieces']}")
    elif went_on != ("went on at" in record["broke_off"][0]):
        wrong.append(f"it says: {record['broke_off']}")
    truth = [pieces for pieces in burned(folder, passes) if pieces]
    stated = [merged(seam["arc_mm"]) for seam in record["seams"]]
    if [len(pieces) for pieces in truth] != [len(pieces) for pieces in stated]:
        return math.inf, [*wrong, f"burned {truth}, stated {stated}"]
    off = float(np.abs(np.concatenate(truth) - np.concatenate(stated)).max())
    if off > UNION_MM:
        wrong.append(f"burned {truth}, stated {stated}")
    return off, wrong


def after_power(lost: bool, work: Callable[[], Any]) -> Any:
    """Do a piece of work on a computer that has just been started, where power was lost."""
    with patch.object(time, "clock_gettime", (lambda _: 0.0) if lost else time.clock_gettime):
        return work()


def records(times: int, seed: int, kinds: tuple[str, ...]) -> int:
    """Break ordered welds off at random; returns the number of records that are not as they should be."""
    rng, bad, counts, worst = np.random.default_rng(seed), 0, Counter[str](), 0.0
    for k in range(times):
        kind, passes = kinds[k % len(kinds)], 1 + k // len(kinds) % 2
        at = (int(rng.integers(passes)), float(rng.uniform(1e-3, 1e-3 * SEAM_MM - 11e-3)))
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as place:
            off, wrong = recorded(kind, passes, at, int(rng.integers(1000)), Path(place))
        bad += bool(wrong)
        worst = max(worst, off)
        counts[f"{kind}, passes: {passes}, {'bad' if wrong else 'good'}"] += 1
        where = f"pass {at[0] + 1} of {passes} at {1e3 * at[1]:.1f} mm, {time.monotonic() - start:.0f} s"
        print(f"{k} {kind} in {where}: union off by {off:.2f} mm", *wrong, sep="\n    ", flush=True)
    print(f"{times} interruptions, {times - bad} records right, union off by at most {worst:.2f} mm")
    print(*sorted(counts.items()), sep="\n")
    return bad


def main(times: int, seed: int, kinds: tuple[str, ...]) -> int:
    """Break welds off at random; returns the number of those that did not go on as they should."""
    rng, bad, counts = np.random.default_rng(seed), 0, Counter[str]()
    across, along, unasked = [], [], 0
    for k in range(times):
        kind, at_m = kinds[k % len(kinds)], float(rng.uniform(FIRST_M, LAST_M))
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as place:
            join = one(kind, at_m, int(rng.integers(1000)), Path(place))
        good = join is not None and join.across_mm <= ACROSS_MM and abs(join.along_mm) <= ALONG_MM
        good = good and join is not None and join.reason is None and join.unasked == 0
        bad += not good
        counts[f"{kind} {'good' if good else 'bad'}"] += 1
        if join is not None:
            across.append(join.across_mm)
            along.append(abs(join.along_mm))
            unasked += join.unasked
        print(f"{k} {kind} at {1e3 * at_m:.2f} mm, {time.monotonic() - start:.0f} s: {join}", flush=True)
    print(f"{times} stops, {bad} bad, {unasked} arcs without a question", *sorted(counts.items()), sep="\n")
    print(f"at most {max(across):.3f} mm across and {max(along):.3f} mm along")
    return bad


if __name__ == "__main__":
    if sys.argv[1:2] == ["record"]:
        more = [*sys.argv[2:], *("40", "0", ",".join(RECORD_KINDS))[len(sys.argv) - 2 :]]
        raise SystemExit(min(records(int(more[0]), int(more[1]), tuple(more[2].split(","))), 1))
    given = [*sys.argv[1:], *("100", "0", ",".join((*SIMULATED, *WIRED)))[len(sys.argv) - 1 :]]
    raise SystemExit(min(main(int(given[0]), int(given[1]), tuple(given[2].split(","))), 1))
