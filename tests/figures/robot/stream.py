"""Timing of the robot link: a 125 Hz command stream through the Diagram, and whole jobs on an emulated controller."""

from __future__ import annotations

import dataclasses as dc
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus
from pydrake.systems.primitives import Adder, Sine, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from tests.worlds.robot.fault_run import LOADED
from tests.worlds.robot.timing import STEP_JOINT, STEP_RAD_S, HostLateness, Tap, watched_host
from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.drivers.ur.faults import Fault
from weldcal.systems.drivers.ur.link import LinkState, UrLink
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde, UrRtdeArm
from weldcal.systems.drivers.ur.wire.transport import NATIVE, UR_RTDE
from weldcal.systems.pacing import no_long_garbage_collections, real_time_priority
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.wall_clock import LIMITS_MS, ON_TIME_MS, Lateness, WallClock
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.run import robot_at
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.ur.process import emulator_process
from weldcal.tools.report.render import csv_text, write_atomic, write_json
from weldcal.tools.report.run import RunOptions

RATE_HZ = 125.0
READ_S = 0.002
MISSED_S = 0.020  # a command that comes so much later than its time is named
TRANSPORT = option("--transport", "NAME", "native or ur_rtde.")
PERCENTILES = (50, 90, 99)
MOST_STOPS = 20

# all but the last joint swing to and fro; the last one jumps, and from its jumps the way to the motion is timed
SWING = np.array([0.10, 0.08, 0.08, 0.10, 0.10, 0.0])  # rad/s
SWING_HZ = 0.25
STEP_S = 0.5
STEPS = (1.0, 0.0, -1.0, 0.0)


class Missed(NamedTuple):
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
    def missed(self) -> list[Missed]:
        """Every one of them."""
        times = np.array(self.tap.command_times)
        late = self.tap.periods - 1.0 / RATE_HZ
        return [Missed(float(times[k + 1] - times[0]), float(late[k])) for k in np.flatnonzero(late > MISSED_S)]

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
    out: Path,
    *,
    address: str | None = None,
    minutes: float = 10.0,
    seed: int = 0,
    lockstep: float = 0.0,
    transport: str = NATIVE,
    progress: Progress = no_progress,
) -> StreamReport:
    """On an emulated controller of its own; robot.json and missed.csv are written into `out`.

    Where this computer stood still for so long that the link stopped the arm, that is a stop in the report, and the
    stream goes on over a new link.
    """
    left, stops, tap = 60.0 * minutes, list[tuple[float, str]](), None
    with emulator_process(host=address, seed=seed, lockstep=lockstep) as emulator:
        while True:
            prepared = PrepareRobot(UrRtde(host=emulator.host, transport=transport), load_arm())
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


def one_transport(name: str) -> str:
    """Return the option's value. Raises InputError for another."""
    if name not in (NATIVE, UR_RTDE):
        raise InputError(f"--transport must be {NATIVE} or {UR_RTDE}, not '{name}'.")
    return name


def _spread(values_s: NDArray[np.float64]) -> dict[str, float]:
    if not values_s.size:
        return {}
    found = {f"p{p}": 1e3 * float(np.percentile(values_s, p)) for p in PERCENTILES}
    return found | {"max": 1e3 * float(values_s.max())}


@command(
    "benchmark robot-stream",
    short_help="Measure the periods of commands streamed at 125 Hz.",
    hidden=True,
    options=("address",),
)
def stream(
    call: Call,
    minutes: Annotated[float, option("--minutes", "M", "Length of the stream.", min=0.05)] = 10.0,
    transport: Annotated[str, TRANSPORT] = NATIVE,
) -> Mapping[str, object]:
    """Stream commands at 125 Hz to an emulated controller: periods, latencies, and deadlines missed by 20 ms or
    more."""
    found = run_robot_benchmark(
        call.folder("benchmark", "robot"),
        address=call.given["address"],
        minutes=minutes,
        seed=call.seed,
        transport=one_transport(transport),
        progress=call.progress,
    )
    return found.summary()


BUSY = "while True: pass"


@contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Programs of ordinary priority that each want a whole core, for the duration of the block."""
    programs = [subprocess.Popen([sys.executable, "-I", "-S", "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


@dataclass(frozen=True, kw_only=True)
class JobTiming:
    """One job: its seed, state and reason, the lateness of its velocities, the slowest rate, and the torch's error."""

    seed: int
    state: str
    reason: str
    lateness: Lateness = field(default_factory=Lateness)
    slowest_percent: float = 0.0
    slowed_s: float = 0.0
    torch_mean_mm: float | None = None

    @property
    def line(self) -> str:
        """One row of the table."""
        late = self.lateness
        torch = self.torch_mean_mm
        return (
            f"{self.state}{': ' + self.reason if self.reason else ''}; {late.on_time_percent:.2f} % of"
            f" {sum(late.counts)} under {ON_TIME_MS:.0f} ms, latest {late.worst_ms:.1f} ms; slowest"
            f" {self.slowest_percent:.0f} %, {self.slowed_s:.2f} s longer"
            + ("" if torch is None else f"; torch {torch:.3f} mm mean")
        )


@dataclass(frozen=True)
class JobsReport:
    """All jobs of a study."""

    jobs: list[JobTiming]
    load: int
    host: HostLateness

    @property
    def lateness(self) -> Lateness:
        """That of all jobs together."""
        counts = np.sum([job.lateness.counts for job in self.jobs], axis=0)
        return Lateness([int(count) for count in counts], max(job.lateness.worst_ms for job in self.jobs))

    def summary(self) -> dict[str, object]:
        """Return the JSON object; `over_8_ms` counts velocities, `limits_ms` bound the bins."""
        late = self.lateness
        return {
            "state": "done",
            "jobs": len(self.jobs),
            "jobs_done": sum(job.state == "done" for job in self.jobs),
            "busy_programs": self.load,
            "under_4_ms_percent": late.on_time_percent,
            "over_8_ms": late.over(8.0),
            "over_8_ms_by_host": self.host.caused([job.lateness for job in self.jobs]),
            "worst_ms": late.worst_ms,
            "limits_ms": list(LIMITS_MS),
            "velocities": late.counts,
            "host": self.host.summary(),
            "slowest_percent": min(job.slowest_percent for job in self.jobs),
            "held": [{"id": f"seed {job.seed}", "reason": job.reason} for job in self.jobs if job.state != "done"],
        }


def run_jobs(
    scenario: str,
    out: Path,
    runs: int,
    *,
    seed: int = 0,
    load: int = 0,
    seam_mm: float | None = None,
    transport: str = NATIVE,
    progress: Progress = no_progress,
) -> JobsReport:
    """Run the scenario's job with consecutive seeds, each on a controller of its own at its own pace, without lockstep.

    Args:
        scenario: name or path.
        out: gets jobs.json, and a folder with the report of each job.
        runs: how many jobs.
        seed: of the first.
        load: busy programs beside.
        transport: native or ur_rtde.
        seam_mm: length of the seam to weld; the scenario's where None.
        progress: gets the job that runs.
    """
    found = []
    overrides = "" if seam_mm is None else f"welding: {{seam_length_mm: {seam_mm}}}"
    with watched_host() as host, busy_programs(load):
        for k in range(runs):
            progress(f"job {k + 1} of {runs}", k / runs)
            described = load_scenario(scenario, overrides)
            described.robot = dc.replace(robot_at("", described), transport=transport)
            found.append(_job(described, out / f"seed{seed + k}", scenario, seed + k))
    report = JobsReport(found, load, host)
    write_json(out / "jobs.json", report.summary() | {"rows": {f"seed {job.seed}": job.line for job in found}})
    return report


def _job(described: Any, out: Path, name: str, seed: int) -> JobTiming:
    q_home = np.deg2rad(described.home_deg)
    kinematics = None if described.kinematics is None else Path(described.kinematics)
    with emulator_process(q=q_home.tolist(), kinematics=kinematics) as controller:
        options = RunOptions(scenario=name, out=out, seed=seed, robot=controller.host, pace=1.0, recording=False)
        try:
            result = run_scenario(described, options)
        except WeldcalError as error:  # the start was refused
            return JobTiming(seed=seed, state="refused", reason=str(error))
    result.run.raise_if_interrupted()
    summary, clock = result.summary(), result.run.clock
    assert clock is not None
    return JobTiming(
        seed=seed,
        state=str(summary["state"]),
        reason=str(summary.get("reason") or ""),
        lateness=clock.lateness,
        slowest_percent=100.0 * clock.slowest_rate,
        slowed_s=clock.slowed_s,
        torch_mean_mm=cast(float | None, summary.get("torch_mean_mm")),
    )


@command("benchmark robot-jobs", short_help="Measure how late velocities are in whole jobs.", hidden=True)
def jobs(
    call: Call,
    scenario: Annotated[
        str, option("--scenario", "NAME", "Name of a scenario, or path of a scenario YAML file.")
    ] = "s_groove",
    runs: Annotated[int, option("--runs", "N", "Number of jobs.", min=1)] = 10,
    load: Annotated[int, option("--load", "N", "Busy programs beside the jobs.", min=0)] = 0,
    seam_mm: Annotated[
        float | None, option("--seam-mm", "MM", "Length of the seam.", min=10.0, show_default="the scenario's")
    ] = None,
    transport: Annotated[str, TRANSPORT] = NATIVE,
) -> Outcome:
    """Run whole jobs on an emulated controller in real time: how late the velocities are, alone or beside busy
    programs."""
    folder = call.folder("benchmark", f"robot-jobs-{scenario}")
    result = run_jobs(
        scenario,
        folder,
        runs,
        seed=call.seed,
        load=load,
        seam_mm=seam_mm,
        transport=one_transport(transport),
        progress=call.progress,
    )
    rows = {f"seed {job.seed}": job.line for job in result.jobs} | {"this computer": result.host.line}
    rows["all"] = result.host.judged([job.lateness for job in result.jobs])
    return Outcome(result.summary(), rows=rows)
