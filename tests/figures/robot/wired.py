"""Inject faults of the devices by wire in each phase of the job, and in long runs."""

import ctypes
import dataclasses as dc
import gc
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from tests.figures.harness import Missed, Run, figure
from tests.worlds.robot.played import WiredWorld, wired_world
from tests.worlds.robot.wired_job import DEVICES, FAULTS, OF_THE_CONTROLLER, PHASES, Happening, run_job
from weldcal.models.errors import WeldcalError
from weldcal.tools.console import Progress
from weldcal.tools.report.render import fixed, mappings_csv, write_atomic

SEAM_MM = 20.0
CALIBRATES = 0.25  # share of the cycles
FAULTY = 0.75
# of the run; does not count for the memory: what is loaded and compiled once, and jobs longer than any before
WARM_UP_SHARE = 1 / 3
FLAT_MB_H = 10.0  # memory is flat where growth above this is not shown at 95 %
FEWEST, SHORTEST_H = 5, 0.25  # cycles and hours for a slope: within minutes what is loaded late looks like growth
PROCESSES = ("cell", "world", "scanner", "finger")
# Of the cell's memory: what C library and Python have given out, and not what they keep for the next allocation
IN_USE = "in_use"
BLOCK_BYTES = 512  # at most, of what Python gives out itself: larger things come from the C library


def run_soak(folder: Path, minutes: float, seed: int, progress: Progress) -> dict[str, Any]:
    """Cycles until the time is over; writes cycles.csv after each cycle."""
    rng = np.random.default_rng([seed, 20])
    rows: list[dict[str, object]] = []
    host = f"127.36.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    begun, length = time.monotonic(), 60.0 * minutes
    with wired_world(folder / "world", host, seed, SEAM_MM, bridged=True) as world:
        while (at := time.monotonic() - begun) < length or not rows:
            happening, calibrates = _drawn(rng)
            what = "no fault" if happening is None else f"{happening.device} {happening.fault} in {happening.phase}"
            progress(f"cycle {len(rows) + 1}: {what}", min(at / length, 0.99))
            row: dict[str, object] = {"cycle": len(rows) + 1, "at_s": at}
            try:
                row |= run_job(world, folder / "job", seed, calibrates=calibrates, happening=happening)
            except WeldcalError as problem:
                row |= {
                    "job": "",
                    "device": what,
                    "state": "failed",
                    "reason": str(problem),
                    "problems": [str(problem)],
                }
            rows.append(row | _processes(world))
            write_atomic(folder / "cycles.csv", mappings_csv(rows))
            if not _alive(world.process.pid):
                break
        world_lives = _alive(world.process.pid)
    return _summary(rows, time.monotonic() - begun, world_lives=world_lives)


def _drawn(rng: np.random.Generator) -> tuple[Happening | None, bool]:
    """Return the next cycle's fault, or None, and whether it calibrates."""
    calibrates = bool(rng.random() < CALIBRATES)
    if rng.random() >= FAULTY:
        return None, calibrates
    device = str(rng.choice(DEVICES))
    faults = (*FAULTS, *OF_THE_CONTROLLER) if device == "controller" else FAULTS
    phase = "calibrate" if calibrates else str(rng.choice([name for name in PHASES if name != "calibrate"]))
    return Happening(device, str(rng.choice(faults)), phase), calibrates


def _processes(world: WiredWorld) -> dict[str, object]:
    """Resident memory (MB) of each process, and the processes that a cycle left behind."""
    gc.collect()
    _return_free_memory()
    pids = dict(zip(PROCESSES, (os.getpid(), world.process.pid, world.scanner, world.finger), strict=True))
    stuck = [pid for pid in _children(os.getpid()) if pid != world.process.pid and not _is_pythons_own(pid)]
    resident = {f"{name}_mb": _resident_mb(pid) for name, pid in pids.items()}
    return {"stuck": len(stuck), f"{IN_USE}_mb": _in_use_mb(), **resident}


def _return_free_memory() -> None:
    """Give free memory of the C library back to the system; else resident memory is the largest ever needed."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # only the GNU library has it
    if trim is not None:
        trim(0)


class _Mallinfo2(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks",
        "keepcost")]  # fmt: skip


def _in_use_mb() -> float:
    """Read what this process has allocated from glibc and Python and not freed, MB; NaN for another library."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if ask is None:
        return float("nan")
    ask.restype = _Mallinfo2
    found = ask()
    return float(found.uordblks + found.hblkhd + BLOCK_BYTES * sys.getallocatedblocks()) / 2**20


def _resident_mb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return float("nan")
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("VmRSS")]
    return kilobytes[0] / 1024 if kilobytes else float("nan")


def _children(pid: int) -> list[int]:
    """Living child processes."""
    found = [int(n) for file in Path(f"/proc/{pid}/task").glob("*/children") for n in file.read_text().split()]
    return [child for child in found if _alive(child)]


def _is_pythons_own(pid: int) -> bool:
    """Return whether it is the one process with which Python keeps count of shared memory, until its owner ends."""
    try:
        return b"resource_tracker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return True


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def growth(hours: np.ndarray, megabytes: np.ndarray) -> dict[str, float | bool | None]:
    """Fit the slope of a memory (MB/h) with its 95 % interval; `flat`: growth above FLAT_MB_H is not shown.

    None where the cycles after the warm-up are fewer than FEWEST, or within SHORTEST_H.

    Args:
        hours: (n,) when each cycle began, h.
        megabytes: (n,) resident memory after it, MB; NaN where unknown.
    """
    kept = np.isfinite(megabytes) & (hours >= WARM_UP_SHARE * np.max(hours, initial=0.0))
    hours, megabytes = hours[kept], megabytes[kept]
    if len(hours) < FEWEST or np.ptp(hours) < SHORTEST_H:
        return {"mb_per_h": None, "low": None, "high": None, "flat": None}
    line = stats.linregress(hours, megabytes)
    # the error of a slope through equal numbers is 0/0 there
    half = float(stats.t.ppf(0.975, len(hours) - 2) * np.nan_to_num(line.stderr))
    slope = float(line.slope)
    low, high = slope - half, slope + half
    return {"mb_per_h": slope, "low": low, "high": high, "flat": bool(low <= FLAT_MB_H)}


def grows(memory: Mapping[str, Mapping[str, object]]) -> list[str]:
    """Whose memory grows.

    The cell is judged by what it uses, where that is known: resident memory has gaps that later jobs fill.
    """
    judged = [name for name in memory if name != "cell" or memory[IN_USE]["flat"] is None]
    return [name for name in judged if memory[name]["flat"] is False]


def _summary(rows: list[dict[str, object]], seconds: float, *, world_lives: bool) -> dict[str, Any]:
    hours = np.array([float(str(row["at_s"])) for row in rows]) / 3600.0
    memory = {}
    for name in (*PROCESSES, IN_USE):
        mb = np.array([float(str(row[f"{name}_mb"])) for row in rows])
        memory[name] = {"first_mb": mb[0], "last_mb": mb[-1], **growth(hours, mb)}
    faults = [row for row in rows if row.get("fault")]
    wrong = [
        f"cycle {row['cycle']} ({row['device']} {row.get('fault', '')}, {row.get('phase', '')}): "
        f"{'; '.join(map(str, row['problems']))}"  # type: ignore[call-overload]
        for row in rows
        if row["problems"]
    ]
    total = {name: sum(float(str(row.get(name) or 0.0)) for row in rows) for name in ("moved", "arc_s", "stuck")}
    sound = [row for row in rows if not row.get("fault") and "velocities" in row]
    good = not wrong and world_lives and not any(total.values()) and not grows(memory)
    return {
        "state": "done" if good else "failed", "seconds": seconds, "cycles": len(rows),
        "calibrated": sum(row["job"] == "calibrate" for row in rows),
        "welded": sum(row["job"] == "weld" for row in rows),
        "done": sum(row["state"] == "done" for row in rows), "held": sum(row["state"] == "held" for row in rows),
        "faults": len(faults),
        "faults_held_by_name": sum(row["state"] == "held" and not row["problems"] for row in faults),
        "faults_without_effect": sum(row["state"] == "done" and not row["problems"] for row in faults),
        "motions_without_a_command": total["moved"], "arc_without_a_command_s": total["arc_s"],
        "jobs_without_a_fault": len(sound),
        "their_velocities_while_the_arm_moves": sum(int(str(row["velocities"])) for row in sound),
        "of_them_over_8_ms_late": sum(int(str(row["over_8_ms"])) for row in sound),
        "latest_ms": max((float(str(row["latest_ms"])) for row in sound), default=0.0),
        "stuck_processes": total["stuck"], "world_lives": world_lives, "memory": memory, "wrong": wrong,
        **({} if good else {"reason": wrong[0] if wrong else
                              "Memory grew, a process is stuck, or the world has "
                              "ended: see the table."}),
    }  # fmt: skip


@figure("soak", "calibrations and welds by wire in one process, with random faults, for 3 minutes (60 in full)")
def soak(run: Run) -> None:
    """Count faults by name, motion and arc without a command and stuck processes, and measure the memory."""
    found = run_soak(run.out, run.size(3.0, 60.0), run.seed, run.progress)
    rows = [
        (key.replace("_", " "), f"{value:.1f}" if isinstance(value, float) else str(value))
        for key, value in found.items()
        if not isinstance(value, dict | list)
    ]
    for name, m in found["memory"].items():
        short = m["mb_per_h"] is None
        slope = "too short a run" if short else f"{m['mb_per_h']:+.1f} MB/h ({m['low']:+.1f} to {m['high']:+.1f})"
        rows.append((f"memory: {name}", f"{m['first_mb']:.0f} to {m['last_mb']:.0f} MB, {slope}"))
    run.table("", ("what", "value"), [*rows, *(("wrong", text) for text in found["wrong"])])
    if found["state"] != "done":
        raise Missed(found["reason"])


TIMES = ("torch_off_after_s", "rest_after_s", "named_after_s")


@figure("wired-faults", "each device by wire killed, frozen, delayed by 2 s or sending garbage, in each phase of a job")
def wired_faults(run: Run) -> None:
    """Disturb each device in each phase (in the quick form the scanner in the weld), one job each."""
    places = [(d, p) for d in DEVICES for p in PHASES] if run.full else [("scanner", "weld")]
    rows: list[dict[str, Any]] = []
    for device, phase in places:
        run.progress(f"{device}, {phase}", len(rows) / len(places) / len(FAULTS))
        folder = run.out / f"{device}_{phase}".replace(" ", "_")
        host = f"127.{40 + DEVICES.index(device)}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
        with wired_world(folder / "world", host, run.seed, SEAM_MM, bridged=True) as world:
            rows += [_row(world, folder, run.seed, Happening(device, fault, phase)) for fault in FAULTS]
    lines = (
        (
            *(str(r[key]) for key in ("device", "fault", "phase", "state")),
            *(fixed(r.get(key)) for key in TIMES),
            *("; ".join(r["problems"]) or "as required", str(r["reason"])),
        )
        for r in rows
    )
    times = ("torch off s", "arm at rest s", "named s")
    run.table("", ("device", "fault", "phase", "job", *times, "verdict", "reason"), lines)
    if wrong := [r for r in rows if r["problems"]]:
        raise Missed(f"{len(wrong)} of {len(rows)} faults were not held by their name; see the table.")


def _row(world: WiredWorld, folder: Path, seed: int, happening: Happening) -> dict[str, Any]:
    calibrates = happening.phase == "calibrate"
    try:
        return run_job(world, folder / happening.fault, seed, calibrates=calibrates, happening=happening)
    except WeldcalError as problem:  # the job did not begin: what the fault before it has left
        return dc.asdict(happening) | {"state": "failed", "reason": str(problem), "problems": [str(problem)]}
