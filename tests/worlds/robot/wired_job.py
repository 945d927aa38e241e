"""One job by wire with one fault: the reason of the job, and the record of the world on arm and arc."""

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.worlds.robot.played import WiredWorld
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.wall_clock import Lateness, WallClock
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.ur.process import Emulator
from weldcal.tools.report.run import RunOptions

DEVICES = ("scanner", "finger camera", "controller", "digital inputs")
FAULTS = ("killed", "frozen", "delayed", "garbage")
OF_THE_CONTROLLER = ("protective_stop", "estop", "stop_program")
PHASES = {
    "calibrate": "scan_pose",
    "scan": "scan_workpiece",
    "approach": "approach_above",
    "feel": "weld",
    "weld": "weld",
}
"""The stage at whose begin a fault is thrown; "weld" is thrown in when the arc is established."""

NAMES = {
    "scanner": "scanner",
    "finger camera": "finger camera",
    "controller": "LINK|GUARD|CONTROLLER|STOP|PROGRAM",
    "digital inputs": "arc|ARC|power source",
}
CALIBRATES = (
    "job: {calibrate: true, weld: false}\ncalibration: {minimum_scans: 4, maximum_scans: 6, required_error_mm: 1.0}\n"
)
OF_THE_LINK: dict[str, tuple[str, dict[str, object]]] = {
    "killed": ("close_tcp", {}),
    "frozen": ("half_open", {}),
    "delayed": ("delay", {"seconds": 2.0, "clock": "controller"}),
    "garbage": ("corrupt", {"n": 50}),
}
ESTABLISHED_S = 0.3  # for which the arc is established before a fault of the phase "weld"
WATCHED_S = 1.0  # after the end, with every device right again
TORCH, ARC = 0, 0  # the torch's digital output, and the digital input of an established arc
TORCH_MAX_MM = 0.35


@dataclass(frozen=True)
class Happening:
    """A fault of a device in a phase."""

    device: str
    fault: str
    phase: str

    @property
    def silent(self) -> bool:
        """Return whether no signal of the device differs from that of a sound one until the job ends.

        The job must then be done, and right.

        A scanner that is not asked says nothing, and nothing is asked of it after the scan of the workpiece; only its
        connection can end. The inputs of a power source whose torch is never lit are off whether their wires are cut,
        stuck or slow.
        """
        if self.device == "scanner":
            return self.fault != "killed" and self.phase in ("approach", "feel", "weld")
        return self.device == "digital inputs" and self.fault != "garbage" and self.phase == "calibrate"


def run_job(
    world: WiredWorld, folder: Path, seed: int, *, calibrates: bool, happening: Happening | None
) -> dict[str, object]:
    """Run one job, throw the fault in, repair it after the end, and judge by the world's record.

    `problems` is empty where the job was held by the fault's name (or done, where the fault is silent), and neither arm
    nor torch moved or burned without a command.
    """
    scenario = load_scenario(str(world.cell), CALIBRATES if calibrates else "")
    stage, thrown, named = [""], [0.0], [0.0]

    def watch(phase: str, _: float) -> None:
        stage[0] = phase
        if phase.startswith(phase_words("held")):
            named[0] = named[0] or time.monotonic()

    with world.control() as controller:
        before = controller.ask(check="summary")
        with _thrown(world, happening, stage, thrown):
            result = run_scenario(scenario, RunOptions(scenario="wired", out=folder, seed=seed, recording=False), watch)
        result.run.raise_if_interrupted()
        ended = time.monotonic()
        held = result.state != "done"
        if held:
            controller.do("note_fault", what="held")
        state = controller.state()
        _repair(world, controller)
        time.sleep(WATCHED_S)
        rest = controller.ask(check="at_rest_after", fault_time=ended, within=0.01)
        torch = controller.ask(check="output_on_after", fault_time=ended, output=TORCH)
        after = controller.ask(check="summary")
        measured = controller.ask(check="at_rest_after", fault_time=thrown[0], within=1e9) if thrown[0] else {}
        burned = controller.ask(check="output_on_after", fault_time=thrown[0], output=TORCH) if thrown[0] else {}
        controller.do("reset_checker")
    reason = str(result.run.reason or "")
    problems = []
    if not held:
        problems += _of_a_job_that_is_done(world, happening if thrown[0] else None, calibrates=calibrates)
    elif happening is None or not thrown[0]:
        problems.append("held without a fault")
    elif not re.search(NAMES[happening.device], reason):
        problems.append("the reason does not name the device")
    if happening is not None and not thrown[0]:
        problems.append("the phase did not come")
    if not rest["ok"]:
        problems.append("the arm moved after the end")
    if torch["on_s"] or state["digital_outputs"] or state["program"] is not None:
        problems.append("the torch or the program was on after the end")
    counts = {
        key: after[key] - before[key] for key in ("moves_without_a_command", "moves_after_a_fault", "unattended_s")
    }
    problems += [f"{key}: {value}" for key, value in counts.items() if value]
    return {
        "device": "" if happening is None else happening.device,
        "fault": "" if happening is None else happening.fault,
        "phase": "" if happening is None else happening.phase,
        "job": "calibrate" if calibrates else "weld",
        "thrown": thrown[0] > 0.0,
        "state": result.state,
        "reason": reason,
        "rest_after_s": measured.get("rest_after_s"),
        "torch_off_after_s": burned.get("last_on_s"),
        "named_after_s": named[0] - thrown[0] if thrown[0] and named[0] else None,
        "wall_s": result.run.wall_seconds,
        "moved": counts["moves_without_a_command"] + counts["moves_after_a_fault"],
        "arc_s": torch["on_s"],
        "problems": problems,
        **_lateness(result.run.clock),
    }


def _lateness(clock: WallClock | None) -> dict[str, object]:
    """How many velocities left while the arm moved, how many of them over 8 ms late, and the latest (ms)."""
    late = Lateness() if clock is None else clock.lateness
    return {"velocities": sum(late.counts), "over_8_ms": late.over(8.0), "latest_ms": late.worst_ms}


def _of_a_job_that_is_done(world: WiredWorld, happening: Happening | None, *, calibrates: bool) -> list[str]:
    if happening is not None and not happening.silent:
        return ["done in spite of the fault"]
    if calibrates:
        return []
    found = world.truth()
    right = found["torch_max_mm"] is not None and found["torch_max_mm"] <= TORCH_MAX_MM and not found["collisions"]
    return (
        []
        if right
        else [
            f"the world's truth: {found['state']}, torch {found['torch_max_mm']} mm, {found['collisions']} collisions"
        ]
    )


@contextmanager
def _thrown(world: WiredWorld, happening: Happening | None, stage: list[str], thrown: list[float]) -> Iterator[None]:
    """Throw the fault in when its phase has come, from a thread of its own; `thrown` becomes the time."""
    over = threading.Event()

    def wait_and_throw(it: Happening) -> None:
        with world.control() as controller:
            while not over.is_set():
                if stage[0].startswith(phase_words(PHASES[it.phase])) and (
                    it.phase != "weld" or controller.state()["digital_inputs"] >> ARC & 1
                ):
                    if it.phase == "weld":
                        over.wait(ESTABLISHED_S)
                    thrown[0] = time.monotonic()
                    _throw(world, controller, it)
                    return
                time.sleep(0.02)

    thread = None
    if happening is not None:
        thread = threading.Thread(target=wait_and_throw, args=(happening,), daemon=True)
        thread.start()
    try:
        yield
    finally:
        over.set()
        if thread is not None:
            thread.join()


def _throw(world: WiredWorld, controller: Emulator, it: Happening) -> None:
    if it.device in world.bridges:
        world.bridges[it.device].how = it.fault
    elif it.device == "digital inputs":
        controller.fault("arc_inputs", how=it.fault, latch=False)
    elif it.fault in OF_THE_CONTROLLER:
        controller.fault(it.fault, latch=False)
    else:
        name, values = OF_THE_LINK[it.fault]
        controller.fault(name, latch=False, **values)


def _repair(world: WiredWorld, controller: Emulator) -> None:
    """Repair every device, as an operator does."""
    for bridge in world.bridges.values():
        bridge.how = ""
    controller.fault("arc_inputs", how="", latch=False)
    controller.do("recover")
    robot = load_scenario(str(world.cell)).robot
    assert isinstance(robot, UrRtde)
    controller.do("set_payload", mass=robot.payload_kg, cog=list(robot.payload_cog_m))
