"""Whole jobs on an emulated controller in real time: how late their velocities are."""

import dataclasses as dc
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.systems.drivers.ur.wire.transport import NATIVE
from weldcal.systems.runner import Progress, no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.wall_clock import LIMITS_MS, ON_TIME_MS, Lateness
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.run import robot_at
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.emulators.ur.process import emulator_process
from weldcal.tools.report.files import write_json
from weldcal.tools.report.run import RunOptions
from weldcal.tools.studies.robot.stream import TRANSPORT, one_transport
from weldcal.tools.worlds.robot.timing import HostLateness, watched_host

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
        """The JSON object; `over_8_ms` counts velocities, `limits_ms` are those of the bins of `velocities` and of the
        host's wake-ups."""
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
