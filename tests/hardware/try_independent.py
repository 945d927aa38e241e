"""Whole jobs with the independent controller, in real time: `python -m tests.hardware.try_independent jobs`.

`jobs` runs scenarios that ship with their robot at the controller's address, each by the command line in a process of
its own, and prints a table. The controller has ordinary priority, unless --own-computer is given. `faults` breaks a
moving session in every way that the control channel knows, or a whole job with --job.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from tests.hardware.independent_process import Controller, independent_controller, move, session
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario

GROOVES = ("straight_groove", "s_groove", "l_groove")
FAST_RAD_S = 0.15
LATE_S = 0.010
WATCHED_S = 1.5  # after the repair and Play
JOB_LIMIT_S = 1200.0


@dataclass(frozen=True)
class Fault:
    """A fault: how it is made, and a word of the sentence that names it."""

    name: str
    make: Callable[[Controller], Any]
    word: str
    rests_s: float = 0.5  # of the controller's time; longer than any that was measured would be no bound


def _reported(name: str) -> Callable[[Controller], Any]:
    return lambda c: c.do("wrong", name=name, seconds=2.0)


FAULTS = (
    Fault("pause", lambda c: c.do("pause"), "PROGRAM PAUSED"),
    Fault("stop", lambda c: c.do("stop"), "PROGRAM STOPPED"),
    Fault("protective stop", lambda c: c.do("protective_stop"), "PROTECTIVE STOP"),
    Fault("emergency stop", lambda c: c.do("emergency_stop"), "EMERGENCY STOP"),
    Fault("NaN in actual_q", _reported("actual_q"), "LINK"),
    Fault("NaN in actual_qd", _reported("actual_qd"), "LINK"),
    Fault("NaN in actual_TCP_pose", _reported("actual_TCP_pose"), "LINK"),
    Fault("NaN in speed_scaling", _reported("speed_scaling"), "LINK"),
    Fault("outputs 300 ms late", lambda c: c.do("delay", seconds=0.3), "LINK"),
    Fault("outputs silent", lambda c: c.do("silent", seconds=1.0), "LINK"),
    Fault("inputs ignored", lambda c: c.do("mute", seconds=1.0), "GUARD"),
    Fault("second program", lambda c: c.do("second_program"), "PROGRAM STOPPED"),
    Fault("connection reset", lambda c: c.do("reset"), "LINK"),
    Fault("slider at 50 %", lambda c: c.do("slider", fraction=0.5), "SPEED SLIDER"),
)


@dataclass(frozen=True)
class Broken:
    """What a fault came to."""

    named: str
    rests_s: float
    resumed_rad: float
    process_on: bool
    late: bool = False  # the controller's frames or the worker's passes came 10 ms late or more


def break_session(controller: Controller, fault: Fault, **settings: Any) -> Broken:
    """Move, make the fault, wait for its name and for rest, repair, press Play, and measure what the arm then
    travels."""
    process = settings.get("process_output") is not None
    slips = controller.state()["late"]["slips"]
    with session(controller, **settings) as link:
        assert move(link, 0.3, process=process) is None
        found: list[dict[str, Any]] = []
        maker = Thread(target=lambda: found.append(_break(controller, fault)))
        maker.start()
        named = move(link, 5.0, process=process)
        maker.join()
        controller.do("mark")
        controller.do("repair")
        controller.do("play")
        until = time.monotonic() + WATCHED_S
        while time.monotonic() < until:
            link.command(np.full(6, 0.1))  # a cell that would go on
            time.sleep(0.01)
        state = controller.state()
        late = state["late"]["slips"] > slips or link.state().worst_period > LATE_S
    controller.do("stop")
    controller.rests(2.0)
    assert found, "the arm did not come to rest"
    rests_s = found[0]["moved_at"] - found[0]["fault"]["at"]
    return Broken(str(named), rests_s, state["travel"], bool(state["digital_out"]), late)


def _break(controller: Controller, fault: Fault) -> dict[str, Any]:
    """Make the fault while the arm moves; returns the controller's state when it is at rest."""
    while controller.speed() < FAST_RAD_S:
        time.sleep(0.002)
    fault.make(controller)
    time.sleep(0.5)
    return controller.rests(4.0)


def job_scenario(name: str, host: str, transport: str, folder: Path, more: str = "") -> Path:
    """A shipped scenario with its robot at this address, as a file."""
    text = (SCENARIO_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    wanted = "" if transport == "default" else f", transport: {transport}"
    line = next(line for line in text.splitlines() if line.startswith("robot:"))
    path = folder / f"{name}.yaml"
    path.write_text(text.replace(line, f"robot: !UrRtde {{host: {host}{wanted}}}") + more, encoding="utf-8")
    return path


def run_job(
    name: str,
    controller: Controller,
    transport: str,
    seed: int,
    during: Callable[[], None] | None = None,
    more: str = "",
) -> dict[str, Any]:
    """One job by the command line; returns its JSON object with what the controller counted."""
    controller.do("mark")
    before, began = controller.state(), time.monotonic()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        scenario = job_scenario(name, controller.host, transport, folder, more)
        command = [sys.executable, "-m", "weldcal.tools", "demo", "--scenario", str(scenario), "--no-browser", "--json"]
        command += ["--seed", str(seed), "--out", str(folder / "out")]
        with (folder / "errors").open("w+") as errors:
            running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
            watcher = Thread(target=during or (lambda: None), daemon=True)
            watcher.start()
            try:
                output, _ = running.communicate(timeout=JOB_LIMIT_S)
            finally:
                running.kill()
            errors.seek(0)
            said = errors.read()
    found: dict[str, Any] = {}
    with suppress(ValueError, IndexError):
        found = json.loads(output.splitlines()[-1])
    state = controller.state()
    late = {key: state["late"][key] - before["late"][key] for key in ("slips", "slipped_ms")}
    return {
        "groove": name, "by": transport, "seed": seed, "exit": running.returncode, **found, "said": said[-600:],
        "wall_s": time.monotonic() - began, "load": os.getloadavg()[0], "slips": late["slips"], "slipped_ms": late["slipped_ms"],
        "program_left": state["program"], "robot_travel_rad": state["travel"],
    }  # fmt: skip


def print_job(job: dict[str, Any]) -> None:
    """One line of the table; the reason where the job was not done."""
    mean, most = job.get("torch_mean_mm"), job.get("torch_max_mm")
    torch = "-" if mean is None else f"{mean:.3f} / {most:.3f}"
    print(
        f"{job['groove']:16s} {job['by']:8s} seed {job['seed']:<3d} {job.get('state', 'no result'):8s} torch"
        f" {torch:15s} mm  {job['wall_s']:5.0f} s  load {job['load']:4.1f}  late {job.get('late_ms')}  controller"
        f" slipped {job['slips']:.0f} times, {job['slipped_ms']:.0f} ms",
        flush=True,
    )
    if job.get("state") != "done":
        print(f"    {job.get('reason')} {job['said']}", flush=True)


def jobs(
    names: list[str],
    transports: list[str],
    seeds: list[int],
    seam_mm: float | None,
    host: str | None,
    own_computer: bool,
) -> int:
    """Run the jobs one after the other with one controller; returns how many were not done."""
    failed = 0
    more = "" if seam_mm is None else f"\nwelding: {{seam_length_mm: {seam_mm}}}\n"
    home = np.deg2rad(load_scenario(names[0]).home_deg).tolist()
    with independent_controller(host, home, own_computer=own_computer) as controller:
        for seed in seeds:
            for name in names:
                for transport in transports:
                    job = run_job(name, controller, transport, seed, more=more)
                    print_job(job)
                    failed += job.get("state") != "done"
        state = controller.state()
        print("modules of the controller outside of the standard library:", ", ".join(state["modules"]))
        print("frames", state["late"])
    print(f"{failed} of {len(names) * len(transports) * len(seeds)} not done")
    return failed


def faults(host: str | None, job: str | None, own_computer: bool, transport: str, only: list[str]) -> int:
    """Make every fault in a session, or in the middle of a job; returns how many were not answered as they must be."""
    failed = 0
    print(f"transport {transport}")
    with independent_controller(host, own_computer=own_computer) as controller:
        for fault in [fault for fault in FAULTS if fault.name in only or not only]:
            settings = {} if transport == "default" else {"transport": transport}
            found = (
                break_session(controller, fault, **settings)
                if job is None
                else break_job(controller, fault, job, transport)
            )
            right = fault.word in found.named and found.rests_s <= fault.rests_s and found.resumed_rad < 1e-6
            failed += not right
            print(
                f"{'ok ' if right else 'BAD'} {fault.name:24s} rest after {1e3 * found.rests_s:4.0f} ms, then"
                f" {found.resumed_rad:.6f} rad  load {os.getloadavg()[0]:.1f}{' (late)' if found.late else ''} "
                f" {found.named}",
                flush=True,
            )
    return failed


def break_job(controller: Controller, fault: Fault, name: str, transport: str) -> Broken:
    """A whole job by the command line, broken when the arm moves fast some seconds after its start."""
    rested: list[float] = []
    after: list[float] = []

    def during() -> None:
        began = controller.state()["started"]
        while controller.state()["started"] == began:
            time.sleep(0.2)
        time.sleep(6.0)
        state = _break(controller, fault)
        rested.append(state["moved_at"] - state["fault"]["at"])
        controller.do("mark")
        time.sleep(0.3)
        controller.do("repair")
        controller.do("play")
        time.sleep(WATCHED_S)
        after.append(controller.state()["travel"])

    found = run_job(name, controller, transport, 1, during)
    until = time.monotonic() + 5.0
    while not after and time.monotonic() < until:
        time.sleep(0.1)
    controller.do("repair")
    controller.do("stop")
    return Broken(
        str(found.get("reason") or found["said"]), rested[0] if rested else 9.0, after[0] if after else 9.0, False
    )


def main() -> int:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("jobs", "faults"))
    parser.add_argument("--host", help="a loopback address")
    parser.add_argument("--scenarios", nargs="+", default=list(GROOVES))
    parser.add_argument("--transports", nargs="+", default=["default"], help="default, native, ur_rtde")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--seam-mm", type=float, help="jobs: weld only so much of the seam")
    parser.add_argument("--job", help="faults: in the middle of a job of this scenario")
    parser.add_argument("--only", nargs="+", default=[], help="faults: their names")
    parser.add_argument("--own-computer", action="store_true", help="the controller takes real-time priority")
    given = parser.parse_args()
    if given.what == "jobs":
        return jobs(given.scenarios, given.transports, given.seeds, given.seam_mm, given.host, given.own_computer)
    return sum(
        faults(given.host, given.job, given.own_computer, transport, given.only) for transport in given.transports
    )


if __name__ == "__main__":
    sys.exit(main() > 0)
