"""Ends a command at a random moment, as Ctrl-C in its terminal or as SIGTERM, and judges what it leaves.

python -m tests.interrupted [TIMES] [SEED] [LONGEST_S]     prints one line for each time that is not as it should be,
and the counts
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.worlds.doctor import write_cell
from weldcal.models.files import UNFINISHED

STARTED = ["sh", "-c", 'trap "" INT; exec "$@"', "sh"]  # as tools/run does
MARK = "WELDCAL_INTERRUPTED"
ENDS_S = 30.0
GONE_S = 6.0
ERRORS = ("Traceback", "Internal error", "Exception ignored", "KeyboardInterrupt", "Error in", "terminate called")


# The arm moves, takes small scans and welds 10 mm; whether it is good at it does not matter here.
QUICK = """
extends: straight_groove
robot: !SimulatedUr {repeatability_mm: 0.0, kinematic_error_mm: 0.0}
scanner: !RenderedScanner
  {preset: phoxi_m, width: 206, height: 154, scale_error: 0.0, warp_mm: 0.0, gradient_error_per_m: [0.0, 0.0]}
calibration: {minimum_scans: 4, maximum_scans: 4, correct_scanner: false, required_error_mm: 5.0}
welding: {seam_length_mm: 10.0}
"""
KNOWN = "job: {calibrate: false, X_BC: {xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}\n"


@dataclass(frozen=True)
class Ended:
    """What a command left that was ended `after_s` s after its start."""

    after_s: float
    code: int | None
    out: str
    err: str
    left: tuple[str, ...]
    folder: Path
    json: bool

    @property
    def before_python(self) -> bool:
        """Whether the signal ended the process before the interpreter ran any of our code."""
        return (
            self.code in (-signal.SIGINT, -signal.SIGTERM)
            and not self.out
            and not self.err
            and not self.folder.exists()
        )

    @property
    def faults(self) -> list[str]:
        """What is not as it should be."""
        found = [f"'{word}' is printed" for word in ERRORS if word in self.out + self.err]
        found += [f"left: {name}" for name in self.left]
        if self.before_python:
            return found
        if self.code not in (0, 1, 130):
            found.append(f"exit code {self.code}")
        unfinished = (self.folder / UNFINISHED).exists()
        if unfinished and str(self.folder) not in self.err:
            found.append("UNFINISHED is not named")
        if self.code == 130:
            sentences = [line for line in self.err.splitlines() if line.startswith("weldcal: ")]
            if len(sentences) != 1:
                found.append(f"{len(sentences)} sentences")
        elif unfinished:
            found.append("not finished, with another exit code")
        if self.json:
            try:
                state = json.loads(self.out.splitlines()[-1])["state"]
            except (IndexError, ValueError, KeyError):
                state = None
            if state != {0: "done", 1: "held", 130: "failed"}.get(self.code or 0):
                found.append(f"JSON says {state}")
        return found


def with_mark(mark: str) -> list[int]:
    """The processes whose environment has the mark, at any depth and in any session."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if f"{MARK}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def end_after(arguments: Sequence[str], after_s: float, number: signal.Signals, folder: Path) -> Ended:
    """Start a command, send a signal after `after_s`, wait for its end and for that of all its processes."""
    mark = uuid.uuid4().hex
    command = [*STARTED, sys.executable, "-P", "-m", "weldcal.tools", *arguments, "--out", str(folder)]
    environment = os.environ | {MARK: mark, "BROWSER": "true", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(command, stdout=out, stderr=err, env=environment, start_new_session=True)
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        if process.poll() is None:
            (os.killpg if number is signal.SIGINT else os.kill)(
                process.pid, number
            )  # a terminal reaches the whole group
        code: int | None = None
        try:
            code = process.wait(ENDS_S)
        except subprocess.TimeoutExpired:  # Ctrl-C came before Python had its handlers: the operator presses again
            process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                code = process.wait(ENDS_S)
        until = time.monotonic() + GONE_S
        while (left := with_mark(mark)) and time.monotonic() < until:
            time.sleep(0.05)
        names = tuple(_name(pid) for pid in left)
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        process.wait()
        out.seek(0)
        err.seek(0)
        return Ended(after_s, code, out.read(), err.read(), names, folder, "--json" in arguments)


def _name(pid: int) -> str:
    try:
        return f"{pid} " + Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()[-120:]
    except OSError:
        return str(pid)


def commands(dataset: Path, moves: Path, scenario: Path) -> dict[str, list[str]]:
    """What is ended: each with the scenario that takes seconds."""
    return {
        "demo": ["demo", "--scenario", str(moves), "--no-browser", "--json"],
        "demo, page": ["demo", "--scenario", str(moves), "--share"],
        "demo, emulated": ["demo", "--scenario", str(moves), "--no-browser", "--json", "--robot", "emulated"],
        "weld": ["weld", "--scenario", str(scenario), "--no-browser", "--record"],
        "calibrate live": ["calibrate", "--scenario", str(scenario), "--json"],
        "calibrate recorded": ["calibrate", str(dataset), "--json"],
    }


def main(times: int, seed: int, longest_s: float) -> int:
    """End commands at random moments, half of them within the first 3 s; returns the number of faults."""
    rng, faults, codes = random.Random(seed), 0, Counter[str]()
    with tempfile.TemporaryDirectory() as place:
        moves, scenario, dataset = (Path(place) / name for name in ("moves.yaml", "short.yaml", "dataset"))
        moves.write_text(QUICK + KNOWN)
        scenario.write_text(QUICK)
        write_cell(dataset, "fine", 1, np.random.default_rng(seed))
        all_of = commands(next(dataset.glob("*/")), moves, scenario)
        for k in range(times):
            name = rng.choice(list(all_of))
            number = rng.choice([signal.SIGINT, signal.SIGTERM])
            ended = end_after(
                all_of[name], rng.uniform(0.0, rng.choice([3.0, longest_s])), number, Path(place) / f"run-{k}"
            )
            codes[f"{name} {number.name}: {ended.code}"] += 1
            for fault in ended.faults:
                faults += 1
                print(f"{k} {name} {number.name} after {ended.after_s:.3f} s, code {ended.code}: {fault}", flush=True)
                print("   ", ended.err[-1500:].replace("\n", "\n    "), flush=True)
    print(f"{times} times, {faults} faults, load {os.getloadavg()}", *sorted(codes.items()), sep="\n")
    return faults


if __name__ == "__main__":
    given = [*sys.argv[1:], *("200", "0", "12")[len(sys.argv) - 1 :]]
    raise SystemExit(min(main(int(given[0]), int(given[1]), float(given[2])), 1))
