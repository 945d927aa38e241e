"""Every target of the profiler study over many seeds: figures, their Cramer-Rao bounds, and the fixed files."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from tests.figures.harness import Run, figure
from tests.figures.profiler.frustum import fit_frustum
from tests.figures.profiler.papers import (
    SPHERE_METHODS,
    TARGETS,
    WorldResult,
    cloud_of,
    edge_figures,
    edge_targets,
    joint_records,
    measured,
    named_figures,
    seam_features,
    sphere_figures,
    sphere_targets,
)
from tests.worlds.edge_trials import fixed_edge_trials, made_edge_trials, rms
from tests.worlds.profiler import MM, WorldData, fixed_worlds, made_worlds
from weldcal.calibration.profiler.arm_errors import DhArm, ProfilerArmErrors
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.tools.report.pictures import OURS, plain, svg

TRIALS = {"free": 20}
WORLDS, GROOVES, BOSSES = 8, 3, 2


def one_seed(seed: int | None = None, data: str | None = None) -> dict[str, Any]:
    """Return every figure of a seed, or of the fixed files in the folder ``data``, with its Cramer-Rao bound.

    Returns:
        values and bounds (mm or deg) by the names of their targets, and the squared errors of the edge's trials in
        units of the bound.
    """
    if data is not None:
        trials = {n: fixed_edge_trials(Path(data), n) for n in TARGETS}
        worlds, number = fixed_worlds(Path(data), WORLDS), 0
    else:
        assert seed is not None
        trials = {n: made_edge_trials(n, TRIALS.get(n.split("_")[0], 10), seed) for n in TARGETS}
        worlds, number = made_worlds(WORLDS, seed, GROOVES, BOSSES), seed
    values: dict[str, float] = {}
    bounds: dict[str, float] = {}
    nees: list[float] = []
    for name, every in trials.items():
        errors, least = [], []
        for trial in every:
            e = trial.joint()
            errors.append(trial.error(e.rotation, e.translation, trial.crb()))
            least.append(trial.bound())
        nees += [e.nees for e in errors]
        values |= edge_figures(name, rms(errors))
        bounds |= edge_figures(name, rms(least))
    results, predicted = _sphere(worlds, number)
    return {"seed": seed, "nees": nees, "values": values | sphere_figures(results), "bounds": bounds | predicted}


def target_lines(seeds: list[dict[str, Any]], fixed: dict[str, Any]) -> list[dict[str, Any]]:
    """Return values and bounds over the seeds for each target, beside the fixed files' where they are known."""
    lines = []
    for what, unit, target in [*edge_targets(TARGETS), *sphere_targets()]:
        values, bounds = (np.array([r[key][what] for r in seeds], dtype=float) for key in ("values", "bounds"))
        over = float(np.sqrt(np.mean(values**2) / np.mean(bounds**2)))
        line = {"what": what, "unit": unit, "target": target, "values": values, "bounds": bounds, "over_bound": over}
        lines.append(line | {"fixed_files": fixed["values"].get(what) if fixed else None})
    return lines


def over_seeds(lines: list[dict[str, Any]]) -> bytes:
    """Return every target over the seeds, each figure as a share of its target: seeds, bounds, and the fixed files."""
    picture = Figure(figsize=(7.6, 0.34 * len(lines) + 1.3), layout="constrained")
    axes = picture.add_subplot()
    for k, n in enumerate(lines):
        seed, bound, files = ("one seed", "its bound, over the seeds", "the fixed files") if k == 0 else (None,) * 3
        shares, places = n["values"] / n["target"], np.full(len(n["values"]), k)
        axes.plot(shares, places, "o", ms=4, mew=0, alpha=0.5, color=OURS, label=seed)
        ends = [np.nanmin(n["bounds"]) / n["target"], np.nanmax(n["bounds"]) / n["target"]]
        axes.plot(ends, [k + 0.28] * 2, "-", lw=3, color="0.45", solid_capstyle="round", label=bound)
        if n["fixed_files"] is not None:
            axes.plot(n["fixed_files"] / n["target"], k, "D", ms=5, mfc="none", mec="black", mew=1.4, label=files)
    axes.axvline(1.0, color="black", lw=1.0, ls="--", label="target, set on the fixed files")
    axes.set_yticks(range(len(lines)), [f"{n['what']}, {n['target']:g} {n['unit']}" for n in lines], fontsize=8)
    axes.invert_yaxis()
    plain(axes, "reached over target", "")
    axes.set_xlim(left=0.0)
    handles, labels = axes.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 4), frameon=False, fontsize=8)
    return svg(picture)


@figure("profiler-seeds", "every target of the figure `profiler` over seeds, beside the Cramer-Rao bound")
def profiler_seeds(run: Run) -> None:
    """Compare with the bound; --data adds the fixed files. 20 s a seed."""
    seeds = []
    for seed in run.seeds(2, 12):
        run.progress(f"seed {seed}", 0.0)
        seeds.append(one_seed(seed))
    lines = target_lines(seeds, {} if run.data is None else one_seed(data=str(run.data)))
    run.write("seeds.svg", over_seeds(lines))
    rows = []
    for n in lines:
        reached = f"{n['values'].min():.3f} to {n['values'].max():.3f} {n['unit']}"
        met = f"{(n['values'] <= n['target']).sum()} of {len(seeds)}"
        files = "" if n["fixed_files"] is None else f"{n['fixed_files']:.3f}"
        rows.append((n["what"], reached, f"{n['over_bound']:.2f}", f"{n['target']:g}", met, files))
    nees = [v for r in seeds for v in r["nees"]]
    what = "edge, squared error in units of the bound"
    rows.append((what, f"{np.mean(nees):.2f}", "", "6 expected", f"{len(nees)} trials", ""))
    run.table("", ("figure", "reached", "of the bound", "target", "met", "fixed files"), rows)


def _sphere(worlds: Iterable[WorldData], seed: int) -> tuple[list[WorldResult], dict[str, float]]:
    """Results of the joint methods, and the figures that their bounds predict."""
    results: list[WorldResult] = []
    bound: dict[str, list[np.ndarray]] = {"points": [], "seam": [], "boss": []}
    for k, world in enumerate(worlds):
        features = seam_features(world)
        for method, record in joint_records(world).items():
            results.append(measured(k, method, record, world, features, boss=method == SPHERE_METHODS[3]))
        for name, value in world_bounds(world, features, 1000 * seed + k).items():
            bound[name].append(value)
    points = float(np.mean(bound["points"]))
    return results, named_figures(dict.fromkeys(SPHERE_METHODS[2:], points), bound["seam"], bound["boss"])


# of the fixed files' worlds: what each error's sigma really is
REAL = SphereSigmas(
    sensor_m=0.05e-3,
    robot_m=0.04e-3,
    touch_m=0.04e-3,
    affine=0.01,
    joint_rad=np.radians(0.015),
    length_m=0.125e-3,
    twist_rad=np.radians(0.01),
    tip_m=3.54e-3,
)
DRAWS, BOSS_DRAWS = 300, 6


def changed(e: SphereEstimate, x: Floats) -> SphereEstimate:
    """Return the estimate with all its unknowns (39,) moved."""
    assert e.tip is not None
    errors = ProfilerArmErrors.of(x[15:])
    return replace(
        e,
        rotation=Rotation.from_rotvec(x[:3]).as_matrix() @ e.rotation,
        translation=e.translation + x[3:6],
        tip=e.tip + x[9:12],
        affine=e.affine + x[12:15],
        arm_errors=ProfilerArmErrors(
            e.arm_errors.offsets + errors.offsets, e.arm_errors.sag + errors.sag, e.arm_errors.table + errors.table
        ),
    )


def _apart(e: SphereEstimate, arm: DhArm, q: Floats, seen: Floats, q_touch: Floats) -> tuple[Floats, FlangePoses]:
    """Vectors (n, 3) m from where the tip touches to where the sensor sees; and the flange at the views."""
    assert e.tip is not None
    X, touch = e.flange(arm, q), e.flange(arm, q_touch)
    sensed = np.einsum("nij,nj->ni", X.rotation, e.points_F(seen)) + X.translation
    return sensed - touch.rotation @ e.tip - touch.translation, X


def predicted_mm(
    e: SphereEstimate, arm: DhArm, q: Floats, seen: Floats, q_touch: Floats, rng: np.random.Generator
) -> float:
    """Return the mean distance that measured and touched points will have, by the bound and by the sensor's noise."""
    at, X = _apart(e, arm, q, seen, q_touch)
    steps = 1e-3 * np.sqrt(np.diag(e.whole))
    J = np.stack(
        [
            (_apart(changed(e, h * u), arm, q, seen, q_touch)[0] - at) / h
            for h, u in zip(steps, np.eye(len(steps)), strict=True)
        ],
        axis=2,
    )
    R_BS = X.rotation @ e.rotation
    plane = R_BS[:, :, [0, 2]]
    C = J @ e.whole @ np.swapaxes(J, 1, 2)
    C = C + REAL.sensor_m**2 * plane @ np.swapaxes(plane, 1, 2) + REAL.robot_m**2 * np.eye(3)
    draws = np.linalg.cholesky(C)[:, None] @ rng.standard_normal((len(C), DRAWS, 3, 1))
    return float(np.linalg.norm(draws[..., 0], axis=2).mean() / MM)


def world_bounds(world: WorldData, features: Floats | None, seed: int) -> dict[str, Floats]:
    """Predict `points` (), `seam` (3,) mm and `boss` (2,) mm and deg by the bound, where the world has them."""
    data, tests = world.trial.data, world.trial.tests
    assert data.arm is not None
    assert tests is not None
    rng = np.random.default_rng([seed, 76])
    e = sphere_joint(data, "affine+joints", REAL)
    found = {"points": np.array(predicted_mm(e, data.arm, tests.q_view, tests.seen, tests.q_touch, rng))}
    if world.groove is not None and features is not None:
        g = world.groove
        found["seam"] = np.array(
            [predicted_mm(e, data.arm, g.q, features[:, j], g.q_touch[:, j], rng) for j in range(3)]
        )
    if world.boss is not None:
        arm = data.arm
        L = np.linalg.cholesky(e.whole)

        def measured(estimate: SphereEstimate) -> Floats:
            record = ProfilerRecord.of("", estimate, {}, "", arm)
            assert world.boss is not None
            b = fit_frustum(cloud_of(record, arm, *world.boss))
            return np.array([b.hips_m / MM, np.degrees(b.dihedrals_rad)])

        here = measured(e)
        off = [
            np.abs(measured(changed(e, L @ rng.standard_normal(len(L)))) - here).mean(axis=1) for _ in range(BOSS_DRAWS)
        ]
        found["boss"] = np.mean(off, axis=0)
    return found
