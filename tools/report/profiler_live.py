"""The report pages of a live profiler run and of many: what was found, how far from the truth, in pictures and a table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from weldcal.models.arrays import Array
from weldcal.systems.jobs.profiler.procedure import ProfilerState
from weldcal.systems.runner import Run
from weldcal.tools.outcomes.first_screen import FirstScreen
from weldcal.tools.outcomes.profiler import LiveOutcome, PoseOutcome
from weldcal.tools.report.plots_profiler_live import path_picture, profiles_picture, sigmas_picture, torch_bars
from weldcal.tools.report.render import fixed, render
from weldcal.tools.report.robot_timing import robot_timing

LIMIT_MM = 0.3


def live_report(
    summary: Mapping[str, object],
    outcome: LiveOutcome,
    state: ProfilerState,
    run: Run[Any],
    *,
    first: FirstScreen,
    recording: bool,
) -> str:
    """One run's page as one self-contained HTML text."""
    poses = {name: [p] for name, p in _poses(outcome).items()}
    paths = {n: p for n in ("points", "curve", "torch") if (p := getattr(outcome, n)) is not None}
    shown = {
        name: min(scans, key=lambda scan: _aside(scan.points)).points
        for name, scans in (("edge", state.edge_scans), ("sphere", state.sphere_scans), ("groove", state.seam_scans))
        if scans
    }
    return render(
        "profiler_live.html.j2",
        many=False,
        first=first,
        s=summary,
        rows=[_row(n, p) for n, p in _poses(outcome).items()],
        sigmas=sigmas_picture(poses) if poses else None,
        seam=path_picture(paths, LIMIT_MM) if paths else None,
        profiles=profiles_picture(shown) if shown else None,
        torch=None,
        per_seed=[],
        header=(),
        tip_mm=outcome.tip_mm,
        recording=recording,
        **robot_timing(run),
    )


def seeds_report(
    found: Mapping[str, object], rows: Sequence[Mapping[str, object]], outcomes: Sequence[LiveOutcome], first_seed: int
) -> str:
    """The page of many seeds."""
    poses = {n: [p for o in outcomes if (p := getattr(o, n)) is not None] for n in ("edge", "sphere")}
    poses = {n: p for n, p in poses.items() if p}
    followed = [(first_seed + k, o.torch) for k, o in enumerate(outcomes) if o.torch is not None]
    columns = [c for c in _COLUMNS if any(c in row for row in rows)]
    return render(
        "profiler_live.html.j2",
        many=True,
        first=None,
        s=found,
        rows=[],
        sigmas=sigmas_picture(poses) if poses else None,
        seam=None,
        profiles=None,
        torch=torch_bars([k for k, _ in followed], [p for _, p in followed], LIMIT_MM) if followed else None,
        per_seed=[tuple(_shown(row.get(c)) for c in columns) for row in rows],
        header=tuple(_COLUMNS[c] for c in columns),
        tip_mm=None,
        recording=False,
    )


_COLUMNS = {
    "seed": "seed",
    "state": "",
    "edge_error_mm": "edge, mm",
    "edge_sigma_mm": "sigma",
    "edge_nees": "NEES",
    "sphere_error_mm": "sphere, mm",
    "sphere_sigma_mm": "sigma",
    "sphere_nees": "NEES",
    "largest_sigmas": "largest",
    "sphere_tip_error_mm": "tip, mm",
    "torch_mean_mm": "torch, mm",
    "torch_max_mm": "at most",
}


def _poses(o: LiveOutcome) -> dict[str, PoseOutcome]:
    return {n: p for n in ("edge", "sphere") if (p := getattr(o, n)) is not None}


def _aside(points: Array) -> float:
    """How far from the middle the nearest face lies in a profile (n, 2) m."""
    p = points[np.isfinite(points).all(axis=1)]
    if not len(p):
        return np.inf
    near = p[:, 1] < np.percentile(p[:, 1], 5.0) + 0.012
    return abs(float(np.mean(p[near, 0])))


def _row(name: str, p: PoseOutcome) -> tuple[str, ...]:
    return (
        name, fixed(p.error_mm, 3), fixed(p.sigma_mm, 3), fixed(p.error_deg, 3), fixed(p.sigma_deg, 3), fixed(p.largest, 2), fixed(p.nees, 1)
    )  # fmt: skip


def _shown(value: object) -> str:
    return fixed(value, 2) if isinstance(value, float) else "–" if value is None else str(value)
