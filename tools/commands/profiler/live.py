"""weldcal profiler live: run the profiler's cell, write its measurements as files, its calibrations and a report; over seeds, a table."""

from __future__ import annotations

import csv
import hashlib
import io
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatParams

from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.errors import InputError
from weldcal.systems.jobs.profiler.cell import ProfilerCell, ProfilerRun, make_profiler_cell, run_profiler_cell
from weldcal.systems.jobs.profiler.estimates import Taken
from weldcal.systems.scenario.schema import Scenario, check_scenario
from weldcal.tools.commands.demo import DemoOptions
from weldcal.tools.commands.profiler.outcome import LiveOutcome, PathOutcome, PoseOutcome, live_outcome
from weldcal.tools.console import Progress
from weldcal.tools.report.profiler_live import live_report, seeds_report
from weldcal.tools.report.render import write_atomic

Array = NDArray[np.float64]
WITHIN_MM = 0.3


@dataclass(frozen=True, eq=False)
class ProfilerLive:
    """What one run came to."""

    options: DemoOptions
    cell: ProfilerCell
    run: ProfilerRun
    outcome: LiveOutcome
    wall_seconds: float

    @property
    def folder(self) -> Path:
        """Where everything was written."""
        return self.options.out

    def summary(self) -> dict[str, object]:
        """The JSON object of `profiler live`, and of `demo` for such a scenario."""
        s, o = self.run.state, self.outcome
        done = s.phase == "done"
        found: dict[str, object] = {"state": "done" if done else "held", "scenario": self.options.scenario}
        found |= {"seed": self.options.seed, "robot": "simulated"}
        if not done:
            found["reason"] = s.reason or "The procedure did not end in time; allow more with maximum_time_s."
        if s.edge is not None and o.edge is not None:
            found["edge"] = _pose(o.edge) | {
                "scans": len(s.edge_scans),
                "without_feature": s.edge.lost,
                "outliers": int((~s.edge.estimate.inliers).sum()),
                "reduced_chi2": s.edge.estimate.reduced_chi2,
                "held_out_mm": float(s.edge.held_out_mm.mean()) if s.edge.held_out_mm.size else None,
            }
        if s.sphere is not None and o.sphere is not None:
            found["sphere"] = _pose(o.sphere) | {
                "scans": len(s.sphere_scans),
                "without_feature": s.sphere.lost,
                "touches": len(s.touches),
                "model": s.sphere.model,
                "reduced_chi2": s.sphere.estimate.reduced_chi2,
                "held_out_mm": float(s.sphere.held_out_mm.mean()) if s.sphere.held_out_mm.size else None,
                "tip_error_mm": o.tip_mm,
                "centre_error_mm": o.center_mm,
            }
        if s.seam is not None and o.curve is not None:
            found["seam"] = {"profiles": len(s.seam_scans), "without_groove": s.seam.lost, **_path("curve", o.curve)}
        if o.torch is not None:
            found |= _path("torch", o.torch)
            found["torch_within_mm"] = WITHIN_MM
            found["torch_is_within"] = bool(o.torch.distance_mm.max() <= WITHIN_MM)
        poses = [p for p in (o.edge, o.sphere) if p is not None]
        if poses:
            found["largest_sigmas"] = max(p.largest for p in poses)
            found["poses_within_3_sigma"] = all(p.within_3_sigma for p in poses)
        found["simulated_seconds"], found["wall_seconds"] = self.run.seconds, self.wall_seconds
        return found


def _pose(p: PoseOutcome) -> dict[str, object]:
    return {
        "error_mm": p.error_mm,
        "error_deg": p.error_deg,
        "sigma_mm": p.sigma_mm,
        "sigma_deg": p.sigma_deg,
        "sigmas": [float(v) for v in p.parts],
        "nees": p.nees,
    }


def _path(name: str, p: PathOutcome) -> dict[str, object]:
    return {f"{name}_mean_mm": float(p.distance_mm.mean()), f"{name}_max_mm": float(p.distance_mm.max())}


def run_profiler_live(scenario: Scenario, options: DemoOptions, progress: Progress) -> ProfilerLive:
    """Build, run, measure, write.

    Raises:
        InputError: the scenario or the options cannot be done; nothing has been written or moved. A run that was held is a
        result too.
    """
    if options.robot not in (None, "simulated"):
        raise InputError("The profiler and the torch's contact are simulated: leave --robot away.")
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    start = time.monotonic()
    progress("build the cell", 0.0)
    meshcat = Meshcat(MeshcatParams(host="localhost")) if options.recording else None
    cell = make_profiler_cell(scenario, options.seed, meshcat)
    with closing(cell.station):
        progress("scan, touch and follow", 0.05)
        run = run_profiler_cell(cell, meshcat)
    progress("measure and write", 0.97)
    live = ProfilerLive(options, cell, run, live_outcome(cell, run), time.monotonic() - start)
    write_live(live, meshcat)
    return live


def write_live(live: ProfilerLive, meshcat: Meshcat | None) -> None:
    """Write edge.npz, sphere.npz, seam.npz (as weldcal profiler reads them), edge/ and sphere/ with profiler.yaml, seam.csv, report.html."""
    s, arm, folder = live.run.state, live.cell.station.arm, live.folder
    folder.mkdir(parents=True, exist_ok=True)
    job = live.cell.scenario.profiler_job
    assert job is not None
    for name, taken, more in (
        ("edge", s.edge_scans, {}),
        ("sphere", s.sphere_scans, _touched(arm, s.touches, job.torch.tip_m, 1e-3 * job.ball.radius_mm)),
        ("seam", s.seam_scans, {}),
    ):
        if not taken:
            continue
        data = _npz(arm, taken, more)
        write_atomic(folder / f"{name}.npz", data)
        estimate = {"edge": None if s.edge is None else s.edge.estimate, "sphere": None if s.sphere is None else s.sphere.estimate}.get(name)  # fmt: skip
        if estimate is not None:
            (folder / name).mkdir(exist_ok=True)
            save_record(
                ProfilerRecord.of(f"{name}, live", estimate, {}, hashlib.sha256(data).hexdigest()), folder / name
            )
    if s.seam is not None:
        rows = [dict(zip(("x_mm", "y_mm", "z_mm"), (f"{1e3 * v:.4f}" for v in p), strict=True)) for p in s.seam.points_B]  # fmt: skip
        write_atomic(folder / "seam.csv", _csv(rows))
    if meshcat is not None:
        write_atomic(folder / "recording.html", meshcat.StaticHtml())
    write_atomic(folder / "report.html", live_report(live.summary(), live.outcome, s, recording=meshcat is not None))


def _npz(arm: ArmModel, taken: Sequence[Taken], more: Mapping[str, Any]) -> bytes:
    """Flange poses, joints and raw profiles."""
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


def run_profiler_seeds(scenario: Scenario, options: DemoOptions, runs: int, progress: Progress) -> dict[str, object]:
    """The same over seeds, each in a folder of its own; seeds.csv grows row by row, report.html shows all."""
    rows: list[dict[str, object]] = []
    outcomes: list[LiveOutcome] = []
    for k in range(runs):
        seed = options.seed + k
        one = replace(options, seed=seed, out=options.out / f"seed{seed:02d}", recording=False)
        live = run_profiler_live(scenario, one, lambda what, share, k=k: progress(what, (k + share) / runs))  # type: ignore[misc]
        rows.append(_flat(live.summary()))
        outcomes.append(live.outcome)
        columns = list(dict.fromkeys(name for row in rows for name in row))
        write_atomic(options.out / "seeds.csv", _csv([{c: row.get(c, "") for c in columns} for row in rows]))
    done = [row for row in rows if row["state"] == "done"]
    found: dict[str, object] = {"state": "done" if len(done) == runs else "held", "scenario": options.scenario}
    found |= {"runs": runs, "runs_done": len(done)}
    if len(done) < runs:
        found["reason"] = next(str(row.get("reason")) for row in rows if row["state"] != "done")
    for name in ("edge", "sphere"):
        poses = [p for o in outcomes if (p := getattr(o, name)) is not None]
        if poses:
            found[f"{name}_mean_nees"] = float(np.mean([p.nees for p in poses]))
            found[f"{name}_largest_sigmas"] = float(np.max([p.largest for p in poses]))
            found[f"{name}_rms_mm"] = float(np.sqrt(np.mean([p.error_mm**2 for p in poses])))
            found[f"{name}_within_3_sigma"] = sum(p.within_3_sigma for p in poses)
    torches = [o.torch.distance_mm for o in outcomes if o.torch is not None]
    if torches:
        found["torch_mean_mm"] = float(np.mean([t.mean() for t in torches]))
        found["torch_max_mm"] = float(np.max([t.max() for t in torches]))
        found["torch_within"] = sum(bool(t.max() <= WITHIN_MM) for t in torches)
    write_atomic(options.out / "report.html", seeds_report(found, rows, outcomes, options.seed))
    return found


def _flat(summary: Mapping[str, object]) -> dict[str, object]:
    """One row: nested figures by their full name, lists left out."""
    row: dict[str, object] = {}
    for name, value in summary.items():
        if isinstance(value, Mapping):
            row |= {f"{name}_{k}": v for k, v in value.items() if not isinstance(v, list)}
        else:
            row[name] = value
    return row


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
