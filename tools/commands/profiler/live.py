"""Run the profiler job: measurement files, calibrations and report; for several seeds, a table."""

import hashlib
import io
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.arrays import Array
from weldcal.systems.jobs.profiler.estimates import TakenProfile
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LIVE, Call, Outcome, RecordOption, ScenarioArgument, command, option
from weldcal.tools.commands.run import JobRun, named_once, run_job, run_options
from weldcal.tools.report.profiler_live import ProfilerLive, live_outcome, live_report
from weldcal.tools.report.render import mappings_csv, write_atomic
from weldcal.tools.report.run import RunOptions

PROFILER_SCENARIO = "profiler_seam"


@command(
    "profiler live",
    short_help="Calibrate a profiler on the arm and follow a seam.",
    options=LIVE,
    defaults={"browser": False},
)
def profiler_live(
    call: Call,
    name: ScenarioArgument = None,
    scenario: Annotated[
        str, option("--scenario", "NAME", "profiler_edge, profiler_sphere, profiler_seam or a YAML file.")
    ] = PROFILER_SCENARIO,
    record: RecordOption = False,
) -> Outcome:
    """Calibrate a profiler on the arm by an edge and a touched sphere, then scan and follow a seam."""
    chosen = named_once(name, scenario, PROFILER_SCENARIO)
    options = run_options(call, "profiler-live", chosen, recording=record)
    found = run_profiler_live(load_scenario(chosen), options, call.progress)
    return Outcome(found.summary(), first=found.first)


def run_profiler_live(scenario: Scenario, options: RunOptions, progress: Progress) -> ProfilerLive:
    """Build and run the cell, evaluate the run and write its results.

    Raises:
        InputError, RobotRefused: see run_job; nothing has been written or moved. A held run also returns a result.
    """
    finished = run_job(scenario, options, progress, "profiler_job")
    progress("measure and write", finished.share(0.97))
    live = ProfilerLive(options, finished.run, live_outcome(finished.run), finished.robot)
    write_live(live, finished)
    return live


def write_live(live: ProfilerLive, finished: JobRun) -> None:
    """Write edge.npz, sphere.npz, seam.npz, edge/ and sphere/ with profiler.yaml, seam.csv and report.html."""
    s, arm, folder = live.state, finished.cell.station.arm, live.folder
    folder.mkdir(parents=True, exist_ok=True)
    job = live.run.cell.job.job
    for name, taken, more in (
        ("edge", s.edge_scans, {}),
        ("sphere", s.sphere_scans, _touched(arm, s.touches, job.torch.tip_m, 1e-3 * job.ball.radius_mm)),
        ("seam", s.seam_scans, {}),
    ):
        if not taken:
            continue
        data = _npz(arm, taken, more)
        write_atomic(folder / f"{name}.npz", data)
        estimate = {
            "edge": None if s.edge is None else s.edge.estimate,
            "sphere": None if s.sphere is None else s.sphere.estimate,
        }.get(name)
        if estimate is not None:
            (folder / name).mkdir(exist_ok=True)
            save_record(
                ProfilerRecord.of(f"{name}, live", estimate, {}, hashlib.sha256(data).hexdigest()), folder / name
            )
    if s.seam is not None:
        rows = [
            dict(zip(("x_mm", "y_mm", "z_mm"), (f"{1e3 * v:.4f}" for v in p), strict=True)) for p in s.seam.points_B
        ]
        write_atomic(folder / "seam.csv", mappings_csv(rows))
    finished.write_recording(folder)
    write_atomic(
        folder / "report.html",
        live_report(
            live.summary(), live.outcome, s, finished.run, first=live.first, recording=finished.meshcat is not None
        ),
    )


def _npz(arm: ArmModel, taken: Sequence[TakenProfile], more: Mapping[str, Any]) -> bytes:
    """Return the bytes of an npz file with flange poses, joints and raw profiles."""
    T = np.array([forward_kinematics(arm, t.q).GetAsMatrix4() for t in taken])
    out = io.BytesIO()
    np.savez_compressed(
        out,
        unit="m",
        T=T,
        q=np.array([t.q for t in taken]),
        profiles=np.array([t.points for t in taken], np.float32),
        held_out=np.array([t.kind == "held_out" for t in taken]),
        **more,
    )
    return out.getvalue()


def _touched(arm: ArmModel, touches: Sequence[Array], tip: Sequence[float], radius_m: float) -> dict[str, Any]:
    more: dict[str, Any] = {"radius": radius_m}
    if touches:
        more["touch_T"] = np.array([forward_kinematics(arm, q).GetAsMatrix4() for q in touches])
        more |= {"touch_q": np.array(touches), "tip": np.array(tip)}
    return more
