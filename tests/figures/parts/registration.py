"""Registers parts from simulated scans and scores each pose: right within its covariance, refused by name, or wrong."""

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.worlds.parts.scans import REFUSALS, PartScene, Subject, scan_scene, subject
from tests.worlds.parts.step_parts import PARTS
from weldcal.models.errors import WeldcalError
from weldcal.models.scanners import get_scanner
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import mappings_csv, write_atomic
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.registration import register_part
from weldcal.welding.locate.part.result import AmbiguousPart, PartNotFound, PartRegistration
from weldcal.welding.locate.part.rivals import same_set, turned_poses
from weldcal.welding.locate.planning import locate_part

Floats = NDArray[np.float64]

NEES_BOUND = float(chi2.ppf(0.9973, 6))  # of a pose within 3 sigma
MEAN_TARGET_MM, MAX_TARGET_MM = 0.3, 0.8
SAME_SURFACE_M = 1e-4
HINT_M, HINT_RAD = 0.04, math.radians(15.0)
SCENES: dict[str, Mapping[str, object]] = {
    "clutter": {"objects": 8, "fingers": 2},
    "missing faces": {"objects": 6, "fingers": 1, "spots": 4},
    "on its side": {"objects": 5, "fingers": 0, "on_side": True},
    "in a vice": {"objects": 4, "fingers": 0, "in_vice": True},
    "partly out of view": {"objects": 5, "fingers": 0, "spread_m": 0.22},
}


Trial = tuple[str, str, int, bool]
"""One registration: a kind of scene (a key of SCENES, or plan), a part, a seed, and whether a hint is given."""


def clutter_trials(seeds: Sequence[int]) -> list[Trial]:
    """Return a scene a seed: kinds and parts take turns, so that twelve seeds have each part once."""
    kinds, names = list(SCENES), list(PARTS)
    return [(kinds[(s + s // 12) % len(kinds)], names[s % len(names)], s, False) for s in seeds]


def plan_trials(seeds: Sequence[int], names: Sequence[str]) -> list[Trial]:
    """Return every part once a seed, among few things; a hint decides between poses that look the same."""
    return [("plan", name, seed, True) for name in names for seed in seeds]


def run(kind: str, name: str, seed: int, hinted: bool) -> dict[str, object]:
    """Scan, register and judge; a row of the table."""
    part = subject(name)
    scanner = get_scanner("phoxi_m", 824)
    number = 1000 * list(PARTS).index(name) + seed
    options: dict[str, object] = {"objects": 4, "fingers": 1} if kind == "plan" else dict(SCENES[kind])
    scene: PartScene = scan_scene(part.mesh, scanner, number, **options)  # type: ignore[arg-type]
    rng = np.random.default_rng([seed, 1803])
    off = RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3) * HINT_RAD), rng.uniform(-1.0, 1.0, 3) * HINT_M)
    row: dict[str, object] = {"kind": kind, "part": name, "seed": seed}
    start = time.process_time()
    try:
        found, joint = locate_part(
            scene.cloud_B, part.mesh, part.seam, None, scene.eye_B, X_BP_hint=scene.X_BP @ off if hinted else None
        )
    except (PartNotFound, AmbiguousPart) as error:
        return {
            **row,
            "verdict": f"refused: {type(error).__name__}",
            "cpu_s": time.process_time() - start,
            "sentence": str(error),
        }
    row["cpu_s"] = time.process_time() - start
    nees = _nees(found, scene.X_BP, part)
    right = nees < NEES_BOUND
    drawn, seam = (_off(line, found, scene, part) for line in (part.seam.points_P, joint.seam.points_P))
    figures = {"drawn_mean_mm": drawn.mean(), "drawn_max_mm": drawn.max(), "seam_mean_mm": seam.mean()}
    row.update({key: float(value) for key, value in figures.items()})
    return {
        **row,
        "verdict": "right" if right else "wrong",
        "nees": nees,
        "seam_max_mm": float(seam.max()),
        "measured": joint.share,
        "sentence": found.summary,
    }


def _off(line_P: Floats, found: PartRegistration, scene: PartScene, part: Subject) -> Floats:
    """Measure how far planned points are from the true seam, mm; a symmetric seam is compared as a set."""
    true = part.seam.transformed(scene.X_BP).points_P
    R = found.X_BP.rotation().matrix()
    return 1e3 * np.asarray(cKDTree(true).query(line_P @ R.T + found.X_BP.translation())[0])


def _nees(found: PartRegistration, X_BP: RigidTransform, part: Subject) -> float:
    """Compute the NEES of the pose, the least over the turns that change neither part nor seam."""
    model = PartModel(part.mesh)
    p = model.points[::20]
    same = [RigidTransform()]
    for X in turned_poses(model, RigidTransform()):
        moved = p @ X.rotation().matrix().T + X.translation()
        on = np.linalg.norm(moved - model.closest(moved)[0], axis=1).max() < SAME_SURFACE_M
        if on or same_set(part.seam.points_P, X):
            same.append(X)
    values = []
    for turn in same:
        E = found.X_BP.InvertAndCompose(X_BP @ turn)
        xi = np.concatenate([Rotation.from_matrix(E.rotation().matrix()).as_rotvec(), E.translation()])
        values.append(float(xi @ np.linalg.solve(found.covariance, xi)))
    return min(values)


def run_refusal(name: str, seed: int) -> dict[str, object]:
    """A subject that must be refused: right when it is, by the error and the words that name why."""
    case = REFUSALS[name]()
    scene = scan_scene(
        case.there, get_scanner("phoxi_m", 824), 50_000 + seed, objects=3, fingers=0, spread_m=0.02, twice=case.twice
    )
    row: dict[str, object] = {"kind": "to refuse", "part": name, "seed": seed}
    start = time.process_time()
    try:
        found = register_part(scene.cloud_B, case.looked_for, eye_B=scene.eye_B)
        row.update(verdict="wrong", sentence=found.summary)
    except WeldcalError as error:
        named = isinstance(error, case.error) and re.search(case.words, str(error)) is not None
        row.update(verdict=f"refused: {type(error).__name__}" if named else "wrong reason", sentence=str(error))
    return {**row, "cpu_s": time.process_time() - start}


def run_registration_study(
    out: Path,
    seeds: range,
    plans: range,
    refusals: range,
    names: Sequence[str] | None = None,
    progress: Progress = no_progress,
) -> Mapping[str, object]:
    """Run scenes with clutter, plans of every part, and subjects to refuse; registrations.csv grows.

    Returns counts, worst figures and the verdict: done when nothing was wrong and the plans are within their targets.
    """
    chosen = list(PARTS) if names is None else list(names)
    jobs: list[Callable[[], dict[str, object]]] = []
    jobs += [partial(run, *trial) for trial in clutter_trials(list(seeds)) if trial[1] in chosen]
    jobs += [partial(run, *trial) for trial in plan_trials(list(plans), chosen)]
    jobs += [partial(run_refusal, name, seed) for name in REFUSALS for seed in refusals]
    rows: list[dict[str, object]] = []
    for k, job in enumerate(jobs):
        rows.append(job())
        write_atomic(out / "registrations.csv", mappings_csv(rows))
        progress(f"{rows[-1]['kind']}: {rows[-1]['part']}", (k + 1) / len(jobs))
    return _summed(rows)


def _summed(rows: list[dict[str, object]]) -> dict[str, object]:
    def of(some: list[dict[str, object]], key: str) -> Floats:
        return np.array([value for row in some if isinstance(value := row.get(key), float)])

    kinds = {
        "clutter": [row for row in rows if row["kind"] in SCENES],
        "plan": [row for row in rows if row["kind"] == "plan"],
        "to_refuse": [row for row in rows if row["kind"] == "to refuse"],
    }
    summary: dict[str, object] = {}
    fine = True
    for kind, some in kinds.items():
        verdicts = [str(row["verdict"]) for row in some]
        refused = sum(v.startswith("refused") for v in verdicts)
        right = verdicts.count("right")
        wrong = len(some) - right - refused
        fine &= wrong == 0
        summary[kind] = {"scenes": len(some), "right": right, "refused": refused, "wrong": wrong}
        if kind != "to_refuse" and right:
            nees = of(some, "nees")
            summary[kind] = {
                **dict(summary[kind]),  # type: ignore[call-overload]
                "nees_mean": float(nees.mean()),
                "nees_max": float(nees.max()),
                "seam_mean_mm": float(of(some, "seam_mean_mm").max()),
                "seam_max_mm": float(of(some, "seam_max_mm").max()),
            }
    plans = kinds["plan"]
    within = sum(
        isinstance(row.get("seam_mean_mm"), float)
        and float(str(row["seam_mean_mm"])) <= MEAN_TARGET_MM
        and float(str(row["seam_max_mm"])) <= MAX_TARGET_MM
        for row in plans
    )
    cpu = of(rows, "cpu_s")
    return {
        "state": "done" if fine and within == len(plans) else "held",
        **summary,
        "plans_within_targets": int(within),
        "cpu_s_median": float(np.median(cpu)) if len(cpu) else None,
        "cpu_s_max": float(cpu.max()) if len(cpu) else None,
    }


@command("benchmark part-registration", short_help="Register twelve parts from STEP files in their scans.", hidden=True)
def registration(
    call: Call,
    part: Annotated[list[str] | None, option("--part", "NAME", "A part; repeat for more.", show_default="all")] = None,
    scenes: Annotated[int, option("--scenes", "N", "Scenes with clutter, without a guess.", min=0)] = 40,
    plans: Annotated[int, option("--plans", "N", "Plans of each part's seam, seeds from --seed on.", min=0)] = 3,
    refusals: Annotated[int, option("--refusals", "N", "Scenes of each subject that must be refused.", min=0)] = 3,
) -> Outcome:
    """Register twelve parts from STEP files in simulated scans, plan their seams, and compare both with the truth."""
    folder = call.folder("benchmark", "part-registration")
    first, second, third = (range(call.seed, call.seed + count) for count in (scenes, plans, refusals))
    return Outcome(run_registration_study(folder, first, second, third, part, call.progress))
