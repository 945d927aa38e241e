"""Every target of the profiler study over many seeds: figures, their Cramer-Rao bounds, and the fixed files."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.arm_errors import ArmErrors, DhArm
from weldcal.calibration.profiler.features.frustum import fit_frustum
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereSigmas
from weldcal.models.errors import InputError
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.profiler.edge import TARGETS, edge_figures, edge_targets
from weldcal.tools.studies.profiler.plots import over_seeds
from weldcal.tools.studies.profiler.results import Reached, TargetLine
from weldcal.tools.studies.profiler.sets import EdgeTrial, fixed_edge_trials, made_edge_trials, rms
from weldcal.tools.studies.profiler.sphere import (
    METHODS,
    MM,
    WorldData,
    WorldResult,
    cloud_of,
    fixed_worlds,
    joint_records,
    made_worlds,
    measured,
    named_figures,
    seam_features,
    sphere_figures,
    sphere_targets,
)

TRIALS = {"free": 20}
WORLDS, GROOVES, BOSSES = 8, 3, 2


@dataclass(frozen=True, kw_only=True)
class SeedStudy:
    """All lines, the mean squared error in units of the bound (6 expected) of the edge's trials, and how long it took."""

    folder: Path
    first: int
    count: int
    lines: tuple[TargetLine, ...]
    nees: float
    trials: int
    wall_seconds: float

    def summary(self) -> dict[str, object]:
        """For JSON."""
        return {
            "state": "done",
            "seeds": [self.first, self.first + self.count - 1],
            "edge_nees": self.nees,
            "edge_trials": self.trials,
            "lines": [
                {
                    "what": line.what, "unit": line.unit, "target": line.target, "median": float(np.median(line.values)),
                    "least": float(line.values.min()), "largest": float(line.values.max()), "met": line.met,
                    "bound": float(np.median(line.bounds)), "over_bound": line.over_bound,
                    "fixed_files": None if line.fixed is None else line.fixed.value,
                    "fixed_files_bound": None if line.fixed is None else line.fixed.bound,
                    "values": line.values, "bounds": line.bounds,
                }
                for line in self.lines
            ],
            "wall_seconds": self.wall_seconds,
            "written_to": self.folder,
        }  # fmt: skip


def run_profiler_seeds(folder: Path, first: int, count: int, data: Path | None, progress: Progress) -> SeedStudy:
    """Every target for `count` seeds, and for the fixed files where their folder is given; writes seeds.json and seeds.svg.

    Raises:
        InputError: the fixed files are not in the folder named.
    """
    if data is not None and not data.is_dir():
        raise InputError(f"There is no folder '{data}': give the one with edge_features.npz and sphere.npz.")
    start = time.monotonic()
    nees: list[float] = []
    fixed: dict[str, Reached] = {}
    if data is not None:
        progress("fixed files", 0.0)
        fixed = _all({n: fixed_edge_trials(data, n) for n in TARGETS}, fixed_worlds(data, WORLDS), 0, [])
    found: list[dict[str, Reached]] = []
    for k in range(count):
        progress(f"seed {first + k}", (k + 0.5) / (count + 0.5))
        seed = first + k
        trials = {n: made_edge_trials(n, TRIALS.get(n.split("_")[0], 10), seed) for n in TARGETS}
        found.append(_all(trials, made_worlds(WORLDS, seed, GROOVES, BOSSES), seed, nees))
    lines = tuple(
        TargetLine(what, unit, target, tuple(f[what] for f in found), fixed.get(what))
        for what, unit, target in [*edge_targets(TARGETS), *sphere_targets()]
    )
    study = SeedStudy(
        folder=folder,
        first=first,
        count=count,
        lines=lines,
        nees=float(np.mean(nees)),
        trials=len(nees),
        wall_seconds=time.monotonic() - start,
    )
    write_json(folder / "seeds.json", study.summary())
    write_atomic(folder / "seeds.svg", over_seeds(study.lines).decode())
    return study


def _all(
    trials: dict[str, Iterator[EdgeTrial]], worlds: Iterable[WorldData], seed: int, nees: list[float]
) -> dict[str, Reached]:
    """Every figure and its bound; the squared errors in units of the bound are appended to `nees`."""
    values: dict[str, float] = {}
    bounds: dict[str, float] = {}
    for name, every in trials.items():
        errors, least = [], []
        for trial in every:
            e = trial.joint()
            errors.append(trial.error(e.rotation, e.translation, trial.crb()))
            least.append(trial.bound())
        nees += [e.nees for e in errors]
        values |= edge_figures(name, rms(errors))
        bounds |= edge_figures(name, rms(least))
    results, predicted = _sphere(worlds, seed)
    values |= sphere_figures(results)
    bounds |= predicted
    return {what: Reached(values[what], bounds[what]) for what in values}


def _sphere(worlds: Iterable[WorldData], seed: int) -> tuple[list[WorldResult], dict[str, float]]:
    """Results of the joint methods, and the figures that their bounds predict."""
    results: list[WorldResult] = []
    bound: dict[str, list[np.ndarray]] = {"points": [], "seam": [], "boss": []}
    for k, world in enumerate(worlds):
        features = seam_features(world)
        for method, record in joint_records(world).items():
            results.append(measured(k, method, record, world, features, boss=method == METHODS[3]))
        for name, value in world_bounds(world, features, 1000 * seed + k).items():
            bound[name].append(value)
    points = float(np.mean(bound["points"]))
    return results, named_figures(dict.fromkeys(METHODS[2:], points), bound["seam"], bound["boss"])


# of the fixed files' worlds: what each error's sigma really is
REAL = SphereSigmas(
    sensor_m=0.05e-3, robot_m=0.04e-3, touch_m=0.04e-3, affine=0.01, joint_rad=np.radians(0.015), length_m=0.125e-3,
    twist_rad=np.radians(0.01), tip_m=3.54e-3,
)  # fmt: skip
DRAWS, BOSS_DRAWS = 300, 6


def changed(e: SphereEstimate, x: Floats) -> SphereEstimate:
    """The estimate with all its unknowns (39,) moved."""
    assert e.tip is not None
    errors = ArmErrors.of(x[15:])
    return replace(
        e,
        rotation=Rotation.from_rotvec(x[:3]).as_matrix() @ e.rotation,
        translation=e.translation + x[3:6],
        tip=e.tip + x[9:12],
        affine=e.affine + x[12:15],
        arm_errors=ArmErrors(
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
    """Mean distance that points seen and touched will have, by the bound and by the noise of seeing them."""
    at, X = _apart(e, arm, q, seen, q_touch)
    steps = 1e-3 * np.sqrt(np.diag(e.whole))
    J = np.stack(
        [(_apart(changed(e, h * u), arm, q, seen, q_touch)[0] - at) / h for h, u in zip(steps, np.eye(len(steps)), strict=True)],
        axis=2,
    )  # fmt: skip
    R_BS = X.rotation @ e.rotation
    plane = R_BS[:, :, [0, 2]]
    C = J @ e.whole @ np.swapaxes(J, 1, 2)
    C = C + REAL.sensor_m**2 * plane @ np.swapaxes(plane, 1, 2) + REAL.robot_m**2 * np.eye(3)
    draws = np.linalg.cholesky(C)[:, None] @ rng.standard_normal((len(C), DRAWS, 3, 1))
    return float(np.linalg.norm(draws[..., 0], axis=2).mean() / MM)


def world_bounds(world: WorldData, features: Floats | None, seed: int) -> dict[str, Floats]:
    """`points` (), `seam` (3,) mm and `boss` (2,) mm and deg that the bound predicts; the last two where the world has them."""
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
