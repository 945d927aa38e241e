"""Timing of the robot link: a 125 Hz command stream through the Diagram."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus
from pydrake.systems.primitives import Adder, Sine, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from tests.figures.harness import Missed, Run, figure
from tests.worlds.robot.fault_run import LOADED
from tests.worlds.robot.timing import STEP_JOINT, STEP_RAD_S, Tap
from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import LinkState, UrLink
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde, UrRtdeArm
from weldcal.systems.pacing import no_long_garbage_collections, real_time_priority
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.wall_clock import WallClock
from weldcal.tools.emulators.ur.process import emulator_process
from weldcal.tools.report.render import csv_text, write_atomic, write_json

RATE_HZ = 125.0
READ_S = 0.002
MISSED_S = 0.020  # a command that comes so much later than its time is named
PERCENTILES = (50, 90, 99)
MOST_STOPS = 20

# all but the last joint swing to and fro; the last one jumps, and from its jumps the way to the motion is timed
SWING = np.array([0.10, 0.08, 0.08, 0.10, 0.10, 0.0])  # rad/s
SWING_HZ = 0.25
STEP_S = 0.5
STEPS = (1.0, 0.0, -1.0, 0.0)


class Late(NamedTuple):
    """A command that came more than MISSED_S after its time: when in the run (s), and by how much it came late (s)."""

    at_s: float
    late_s: float


@dataclass(frozen=True)
class StreamReport:
    """One stream.

    `fault` is empty where it went through to its end. `stops`: when in the run (s) the link stopped the arm by itself,
    and its reason, lived through with a new start.
    """

    seconds: float
    tap: Tap
    final: LinkState
    clock: WallClock
    fault: str
    stops: tuple[tuple[float, str], ...] = ()

    @property
    def missed(self) -> list[Late]:
        """Every one of them."""
        times = np.array(self.tap.command_times)
        late = self.tap.periods - 1.0 / RATE_HZ
        return [Late(float(times[k + 1] - times[0]), float(late[k])) for k in np.flatnonzero(late > MISSED_S)]

    def summary(self) -> dict[str, object]:
        """Return the JSON object: milliseconds unless the key says otherwise.

        command_period_ms: from one command to the next where the cell hands them over. echo_ms: from the worker's
        sending to its reading that the script on the controller has the number. command_to_motion_ms: from the
        hand-over of a velocity step to the first sample at the Diagram in which the joint has half of it. state_age_ms:
        of the sample, by the robot's own timestamp, each time the Diagram reads it.
        """
        tap, missed = self.tap, self.missed
        return {
            "state": "failed" if self.fault else "done",
            "reason": self.fault or None,
            "seconds": self.seconds,
            "commands": len(tap.command_times),
            "command_period_ms": _spread(tap.periods[np.isfinite(tap.periods)]),
            "echo_ms": _spread(np.array(tap.echoes)),
            "command_to_motion_ms": _spread(np.array(tap.motions)),
            "velocity_steps": len(tap.motions),
            "state_age_ms": _spread(np.array(tap.ages)),
            "state_reads": len(tap.ages),
            "worker_worst_period_ms": 1e3 * self.final.worst_period,
            "worker_late_periods": self.final.late_periods,
            "clock_residual_ms": 1e3 * self.final.clock_residual,
            "clock_drift_ppm": 1e6 * self.final.clock_drift,
            "diagram_late_ms": 1e3 * self.clock.late_s,
            "diagram_reanchored": self.clock.reanchored,
            "stops": [{"id": f"at {at_s:.3f} s", "reason": sentence} for at_s, sentence in self.stops],
            "missed_deadlines": len(missed),
            "missed": [{"id": f"at {m.at_s:.3f} s", "reason": f"{1e3 * m.late_s:.1f} ms late"} for m in missed],
        }


def run_stream(tap: Tap, arm: ArmModel, seconds: float, progress: Progress = no_progress) -> StreamReport:
    """Moves the arm for so long, paced by the wall clock; ends early where the link latches a fault."""
    builder, clock = DiagramBuilder(), WallClock(1.0)
    robot = builder.AddNamedSystem("robot", UrRtdeArm(arm, cast(UrLink, tap), clock, READ_S, 1.0 / RATE_HZ))
    frequencies = np.full(6, 2.0 * np.pi * SWING_HZ)
    swing = builder.AddNamedSystem("swing", Sine(SWING, frequencies, np.zeros(6), True))
    steps = builder.AddNamedSystem("steps", TrajectorySource(_steps(seconds)))
    both = builder.AddNamedSystem("both", Adder(2, 6))
    builder.Connect(swing.get_output_port(0), both.get_input_port(0))
    builder.Connect(steps.get_output_port(), both.get_input_port(1))
    builder.Connect(both.get_output_port(), robot.GetInputPort("velocity_command"))
    diagram = builder.Build()
    simulator = Simulator(diagram)

    def watch(root: Context) -> EventStatus:
        now = root.get_time()
        clock.wait_for(now, moving=True)
        if round(now / READ_S) % 500 == 0:
            progress("stream", now / seconds)
        if tap.state_now is not None and tap.state_now.fault is not Fault.NONE:
            return EventStatus.ReachedTermination(diagram, tap.state_now.status.fault or "")
        return EventStatus.DidNothing()

    with no_long_garbage_collections(), real_time_priority():
        simulator.Initialize()
        simulator.set_monitor(watch)
        simulator.AdvanceTo(seconds)
    simulator.clear_monitor()
    final = tap.link.state()
    return StreamReport(simulator.get_context().get_time(), tap, final, clock, final.status.fault or "")


def run_robot_benchmark(
    out: Path, *, minutes: float = 10.0, seed: int = 0, lockstep: float = 0.0, progress: Progress = no_progress
) -> StreamReport:
    """On an emulated controller of its own; robot.json and missed.csv are written into `out`.

    Where this computer stood still for so long that the link stopped the arm, that is a stop in the report, and the
    stream goes on over a new link.
    """
    left, stops, tap = 60.0 * minutes, list[tuple[float, str]](), None
    with emulator_process(seed=seed, lockstep=lockstep) as emulator:
        while True:
            prepared = PrepareRobot(UrRtde(host=emulator.host), load_arm())
            link = cast(UrLink, prepared.handle)
            if tap is None:
                tap = Tap(link=link)
            else:
                tap.restart(link)
            try:
                report = run_stream(tap, prepared.arm, left, progress)
            finally:
                link.close()
            left -= report.seconds
            if report.final.fault.name not in (*LOADED, "GUARD_LATCHED") or len(stops) == MOST_STOPS:
                break
            stops.append((60.0 * minutes - left, report.fault))
    report = replace(report, seconds=60.0 * minutes - left, stops=tuple(stops))
    write_json(out / "robot.json", report.summary())
    missed = ((f"{m.at_s:.3f}", f"{1e3 * m.late_s:.2f}") for m in report.missed)
    write_atomic(out / "missed.csv", csv_text(("at_s", "late_ms"), missed))
    return report


def _steps(seconds: float) -> PiecewisePolynomial:
    """Velocity (6,) rad/s that jumps every STEP_S, zero at first and for good from `seconds` on."""
    n = int(seconds / STEP_S) + 2
    samples = np.zeros((6, n))
    samples[STEP_JOINT, 1:-1] = STEP_RAD_S * np.resize(STEPS, n - 2)
    return PiecewisePolynomial.ZeroOrderHold(STEP_S * np.arange(n), samples)


def _spread(values_s: NDArray[np.float64]) -> dict[str, float]:
    if not values_s.size:
        return {}
    found = {f"p{p}": 1e3 * float(np.percentile(values_s, p)) for p in PERCENTILES}
    return found | {"max": 1e3 * float(values_s.max())}


@figure("robot-stream", "a 125 Hz command stream through the Diagram to an emulated controller: periods, latencies")
def robot_stream(run: Run) -> None:
    """Stream for ten minutes (12 s in the quick form); deadlines missed by 20 ms or more are named."""
    report = run_robot_benchmark(run.out, minutes=run.size(0.2, 10.0), seed=run.seed, progress=run.progress)
    found = report.summary()
    spreads = {name: value for name, value in found.items() if isinstance(value, dict)}
    rows = ((name, *(f"{v:.2f}" for v in value.values())) for name, value in spreads.items())
    run.table("", ("figure", *(f"p{p}" for p in PERCENTILES), "max"), rows)
    run.table("", ("figure", "found"), ((k, str(v)) for k, v in found.items() if k not in spreads))
    if report.fault:
        raise Missed(report.fault)
