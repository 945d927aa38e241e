"""Registers parts from simulated scans and scores each pose: right within its covariance, refused by name, or wrong."""

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.figures.harness import Run, figure
from tests.worlds.parts.scans import REFUSALS, PartScene, Subject, scan_scene, subject
from tests.worlds.parts.step_parts import PARTS
from weldcal.models.errors import WeldcalError
from weldcal.models.scanners import get_scanner
from weldcal.tools.report.render import mappings_csv
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.registration import register_part
from weldcal.welding.locate.part.result import AmbiguousPart, PartNotFound, PartRegistration
from weldcal.welding.locate.part.rivals import same_set, turned_poses
from weldcal.welding.locate.planning import locate_part

Floats = NDArray[np.float64]

NEES_BOUND = float(chi2.ppf(0.9973, 6))  # of a pose within 3 sigma
MEAN_TARGET_MM, MAX_TARGET_MM = 0.3, 0.8
WORST = ("nees", "seam_mean_mm", "seam_max_mm", "cpu_s")
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


def run(kind: str, name: str, seed: int, hinted: bool) -> dict[str, Any]:
    """Scan, register and judge; a row of the table."""
    part = subject(name)
    scanner = get_scanner("phoxi_m", 824)
    number = 1000 * list(PARTS).index(name) + seed
    options: dict[str, Any] = {"objects": 4, "fingers": 1} if kind == "plan" else dict(SCENES[kind])
    scene: PartScene = scan_scene(part.mesh, scanner, number, **options)
    rng = np.random.default_rng([seed, 1803])
    off = RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3) * HINT_RAD), rng.uniform(-1.0, 1.0, 3) * HINT_M)
    row: dict[str, Any] = {"kind": kind, "part": name, "seed": seed}
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


def run_refusal(name: str, seed: int) -> dict[str, Any]:
    """A subject that must be refused: right when it is, by the error and the words that name why."""
    case = REFUSALS[name]()
    scene = scan_scene(
        case.there, get_scanner("phoxi_m", 824), 50_000 + seed, objects=3, fingers=0, spread_m=0.02, twice=case.twice
    )
    row: dict[str, Any] = {"kind": "to refuse", "part": name, "seed": seed}
    start = time.process_time()
    try:
        found = register_part(scene.cloud_B, case.looked_for, eye_B=scene.eye_B)
        row.update(verdict="wrong", sentence=found.summary)
    except WeldcalError as error:
        named = isinstance(error, case.error) and re.search(case.words, str(error)) is not None
        row.update(verdict=f"refused: {type(error).__name__}" if named else "wrong reason", sentence=str(error))
    return {**row, "cpu_s": time.process_time() - start}


def summed(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Count right, refused and wrong by kind of scene, with the worst figures of those that are right.

    Plans beyond the targets of the seam count as wrong.
    """
    found: dict[str, dict[str, float]] = {}
    for kind in ("clutter", "plan", "to refuse"):
        some = [row for row in rows if row["kind"] == kind or (kind == "clutter" and row["kind"] in SCENES)]
        good = [row for row in some if row["verdict"] == "right"]
        far = [r for r in good if r["seam_mean_mm"] > MEAN_TARGET_MM or r["seam_max_mm"] > MAX_TARGET_MM]
        refused = sum(row["verdict"].startswith("refused") for row in some)
        wrong = len(some) - len(good) - refused + (len(far) if kind == "plan" else 0)
        worst = {f"worst {key}": max(row[key] for row in good) for key in WORST} if good else {}
        found[kind] = {"scenes": len(some), "right": len(good), "refused": refused, "wrong": wrong, **worst}
    return found


@figure("part-registration", "twelve parts from STEP files found in their scans: right, refused, wrong, and errors")
def registration(run_: Run) -> None:
    """Register parts in scenes with clutter, plan their seams, and give subjects that must be refused."""
    scenes, plans, refusals = run_.size((1, 1, 0), (40, 3, 3))
    first = range(run_.seed, run_.seed + scenes)
    names = run_.size(("lap",), tuple(PARTS))
    jobs: list[Callable[[], dict[str, Any]]] = []
    jobs += [partial(run, *trial) for trial in clutter_trials(list(first))]
    jobs += [partial(run, *trial) for trial in plan_trials(range(run_.seed, run_.seed + plans), names)]
    jobs += [partial(run_refusal, name, seed) for name in REFUSALS for seed in range(run_.seed, run_.seed + refusals)]
    rows: list[dict[str, Any]] = []
    for k, job in enumerate(jobs):
        run_.progress("parts", k / len(jobs))
        rows.append(job())
    run_.write("registrations.csv", mappings_csv(rows))
    for kind, found in summed(rows).items():
        run_.table(kind, ("figure", "found"), ((name, f"{v:.3g}") for name, v in found.items()))
