"""Breaks short welds off at random places, goes on with each, and judges the join by the simulation's truth.

python -m tests.restarted [TIMES] [SEED] [KINDS]     prints one line for each stop, and the counts
"""

from __future__ import annotations

import mmap
import os
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.held_weld import short_weld
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.operator import Operator
from weldcal.systems.runner import run_cell
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.weld import keeper_of, restarting
from weldcal.tools.emulators.ur.process import LOCKSTEP_S, Emulator, emulator_process
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import weld_outcome
from weldcal.welding.record.progress import Progress, load_progress

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
        found: Join | None = apart(lambda: go_on(scenario(), seed, progress, place / "2", torch))[1]
        return found


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
    given = [*sys.argv[1:], *("100", "0", ",".join((*SIMULATED, *WIRED)))[len(sys.argv) - 1 :]]
    raise SystemExit(min(main(int(given[0]), int(given[1]), tuple(given[2].split(","))), 1))
