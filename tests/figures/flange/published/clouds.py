"""Compares both methods on the same real scans: circles, registrations, Algorithm 1, and errors on held-out scans."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from tests.figures.flange.published.pipeline import (
    PublishedVerification,
    all_pairs,
    find_centres,
    published_model,
    published_pairs,
    search_circle,
)
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly
from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.published.algorithm1 import (
    Algorithm1State,
    Method,
    Verification,
    algorithm1_start,
    algorithm1_step,
    icp_error,
    make_verification,
    sight,
)
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard
from weldcal.tools.console import Progress

ICP_POINTS = 2_500
"""Points of a face that the repeated registrations use, of some 12 000: they differ by less than what they cannot
see."""
METHODS = {
    "algorithm1": "Alg. 1, circles, point-to-point",
    "compensated": "the same, compensated (Eq. 21)",
    "plane": "Alg. 1, circles, point-to-plane",
    "edges": "Alg. 1 on weldcal's centres",
    "svd": "all circles, SVD (Table 1)",
    "rigid": "weldcal, scanner as it is",
    "ours": "weldcal, scanner corrected",
}
RUNS_OF_ALGORITHM1 = ("algorithm1", "plane", "edges")


@dataclass(frozen=True, eq=False)
class CircleRow:
    """The circle of one cloud: 3-D rms (m) of the published centre over seeds, and its offset (3,) m in R.

    The offset is from the edges' centre; also how far apart the centres from two random halves of the cloud are,
    both methods (m).
    """

    id: str
    repeat_m: float
    offset_R: Array
    halves_published_m: float
    halves_ours_m: float


@dataclass(frozen=True, eq=False)
class SightRow:
    """A kind of registration against a good calibration.

    ``value`` (6,) it reports (rad, m, at the flange centre), ``share`` (6,) of a known error it shows, the
    components it names blind.
    """

    title: str
    value: Array
    share: Array
    blind: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SplitRow:
    """One method over all splits: errors (m) on held-out scans, and what it reports by split (NaN: nothing)."""

    name: str
    held_out: Array
    reported: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudsOutcome:
    """A folder of scans.

    ``table1_camera`` (n, 6): e_icp of the all-circles H with each scan as the verification, at the camera (roll, pitch,
    yaw, x, y, z). ``path`` (orders, steps, 6) e_icp of Algorithm 1 (Fig. 11) and
    ``path_true`` (orders, steps) m, the median error on scans outside its pool at that step.
    """

    name: str
    title: str
    n: int
    refused: tuple[tuple[str, str], ...]
    verification: str
    circles: tuple[CircleRow, ...]
    table1_camera: Array
    sights: tuple[SightRow, ...]
    path: Array
    path_true: Array
    splits: tuple[SplitRow, ...]
    n_fit: int

    @property
    def circle_row(self) -> tuple[str, ...]:
        """Of the published circle, mm: rms of its centres over seeds, and their mean offset in the flange's axes.

        Then the median distance of the centres from two halves of a cloud: published, and by weldcal's edges.
        """
        repeat = np.sqrt(np.mean([r.repeat_m**2 for r in self.circles]))
        offset = np.mean([r.offset_R for r in self.circles], axis=0)
        halves = (np.median([getattr(r, f"halves_{m}_m") for r in self.circles]) for m in ("published", "ours"))
        return tuple(f"{1e3 * v:.3f}" for v in (repeat, *offset, *halves))


@dataclass(frozen=True, eq=False, kw_only=True)
class Material:
    """What both methods see of a folder: our observations, published circles of the same scans, and the CAD."""

    data: Dataset
    standard: FlangeStandard
    seen: FlangeObservations
    faces: dict[str, Array]
    circles: list[Observation]
    good: dict[str, Observation]
    model: tuple[Array, Array]

    def verifier(self, id: str, method: str) -> PublishedVerification:
        """Eq. (13) at that scan, thinned, in the unit of the authors' AUBO clouds (m)."""
        face = self.faces[id]
        keep = np.random.default_rng(0).permutation(len(face))[:ICP_POINTS]
        kind: Method = "point_to_plane" if method == "plane" else "point_to_point"
        return PublishedVerification(
            points_C=face[np.sort(keep)],
            X_BF=self.data.poses[id],
            model_F=self.model[0],
            normals_F=self.model[1],
            method=kind,
            max_distance_m=0.01,
            unit_m=1.0,
        )


def study_clouds(
    name: str,
    title: str,
    data: Dataset,
    standard: FlangeStandard,
    *,
    orders: int,
    splits: int,
    seed: int,
    progress: Progress,
    circles: int | None = None,
) -> CloudsOutcome:
    """Study one folder of segmented scans.

    ``orders`` shuffled runs of Algorithm 1, ``splits`` comparisons on held-out scans, repeated circles of the first
    ``circles`` scans (all where None). Raises InputError when fewer than ten show a flange to both methods.
    """
    progress("circles and edges", 0.0)
    material = read_material(data, standard, seed)
    ids = [o.id for o in material.circles]
    if len(ids) < 10:
        raise InputError(f"'{data.folder.name}' shows a flange in {len(ids)} scans; the comparison needs at least ten.")
    middle = np.median([o.p_BR for o in material.circles], axis=0)
    held = min(material.circles, key=lambda o: (float(np.linalg.norm(o.p_BR - middle)), o.id)).id
    rows = []
    R_BC = estimate_eye_on_base(list(material.good.values()), SolveConfig(leave_one_out=False)).X_BC.rotation().matrix()
    for k, id in enumerate(ids[:circles]):
        progress("repeating circles", 0.2 + 0.2 * k / len(ids))
        rows.append(_circle_row(material, id, R_BC, seed))
    progress("registrations", 0.4)
    camera = _table1(material, ids)
    sights = _sights(material, held)
    path, path_true = [], []
    for r in range(orders):
        progress("Algorithm 1, order by order", 0.45 + 0.2 * r / orders)
        steps, true = _path(material, held, np.random.default_rng([seed, r]))
        path.append(steps)
        path_true.append(true)
    results: dict[str, list[tuple[Array, float]]] = {name: [] for name in METHODS}
    n_fit = round(len(ids) * 2 / 3)
    for r in range(splits):
        progress("splits", 0.65 + 0.35 * r / splits)
        order = np.random.default_rng([seed, 100 + r]).permutation(len(ids))
        for name_, outcome in split_once(material, [ids[i] for i in order[:n_fit]], seed).items():
            results[name_].append(outcome)
    table = tuple(
        SplitRow(m, np.concatenate([e for e, _ in found]), np.array([v for _, v in found]))
        for m, found in results.items()
    )
    return CloudsOutcome(
        name=name,
        title=title,
        n=len(ids),
        refused=material.seen.refused,
        verification=held,
        circles=tuple(rows),
        table1_camera=camera,
        sights=sights,
        path=np.array(path),
        path_true=np.array(path_true),
        splits=table,
        n_fit=n_fit,
    )


def read_material(data: Dataset, standard: FlangeStandard, seed: int) -> Material:
    """Fit every cloud by both methods; clouds that either method refuses are left out of the comparison."""
    seen = fit_flanges(data, standard, seed=seed)
    good = {o.id: o for o in seen.observations}
    clouds = {id: data.cloud(id) for id in data.clouds if id in good}
    circles, faces, _ = find_centres(clouds, seed=seed)
    return Material(
        data=data,
        standard=standard,
        seen=seen,
        faces=faces,
        circles=published_pairs(circles, data.poses),
        good=good,
        model=published_model(standard, 8000),
    )


def split_once(material: Material, fit: list[str], seed: int) -> Mapping[str, tuple[Array, float]]:
    """Every method of METHODS on the scans ``fit``: errors (m) on all others, at our centres, and its own figure (m).

    Scored on weldcal's centres for all: they repeat to a fiftieth of what is judged. The scans that Algorithm 1 is
    verified with are among ``fit``; nobody sees the others.
    """
    pairs = {o.id: o for o in material.circles}
    rest = [material.good[id] for id in pairs if id not in fit]
    middle = np.median([pairs[id].p_BR for id in fit], axis=0)
    held = min(fit, key=lambda id: float(np.linalg.norm(pairs[id].p_BR - middle)))
    pool = [id for id in fit if id != held]
    out: dict[str, tuple[Array, float]] = {}
    for method in RUNS_OF_ALGORITHM1:
        source = material.good if method == "edges" else pairs
        state = algorithm1_start(1e-12, 1000)
        verifier = material.verifier(held, method)
        for id in pool:
            state = algorithm1_step(state, source[id], verifier)
        out[method] = _judged(state, state.X_BC, rest)
        if method == "algorithm1":
            errors, _figure = _judged(state, state.X_BC_compensated, rest)
            out["compensated"] = (errors, float("nan"))
    out["svd"] = (position_errors(all_pairs([pairs[id] for id in fit]), rest), float("nan"))
    ours = [material.good[id] for id in fit]
    estimate = estimate_eye_on_base(ours, SolveConfig(seed=seed))
    out["rigid"] = (position_errors(estimate.X_BC, rest), float(np.median(estimate.held_out.position_m)))
    corrected, _ = estimate_jointly(ours, material.seen.patterns, config=SolveConfig(seed=seed))
    accepted = corrected.correction or ScannerCorrection()
    errors = position_errors(corrected.X_BC, [corrected_observation(accepted, o) for o in rest])
    out["ours"] = (errors, float(np.median(corrected.held_out.position_m)))
    return {name: out[name] for name in METHODS}


def _judged(state: Algorithm1State, X: RigidTransform | None, rest: list[Observation]) -> tuple[Array, float]:
    if X is None:
        return np.full(len(rest), np.nan), float("inf")
    return position_errors(X, rest), state.cost


def _circle_row(material: Material, id: str, R_BC: Array, seed: int) -> CircleRow:
    face, o = material.faces[id], material.good[id]
    centres = np.array([search_circle(face, seed=seed + 1 + k).center_C for k in range(4)])
    R_RC = o.X_BR.rotation().matrix().T @ R_BC
    half = np.random.default_rng(seed).permutation(len(face)) < len(face) // 2
    published = [search_circle(face[h], seed=seed).center_C for h in (half, ~half)]
    halves = see_halves(face, half, material.standard)
    return CircleRow(
        id,
        float(np.sqrt(centres.var(axis=0, ddof=1).sum())),
        R_RC @ (centres.mean(axis=0) - o.p_CR),
        float(np.linalg.norm(published[0] - published[1])),
        float(np.linalg.norm(halves[0] - halves[1])),
    )


def see_halves(face: Array, half: NDArray[np.bool_], standard: FlangeStandard) -> tuple[Array, Array]:
    """Return the edges' centres (3,) m from either half of a cloud."""
    return fit_flange(face[half], standard).center_C, fit_flange(face[~half], standard).center_C


def _table1(material: Material, ids: list[str]) -> Array:
    fits = {id: all_pairs([o for o in material.circles if o.id != id]) for id in ids}
    return np.array([material.verifier(id, "algorithm1")(X).value for id, X in fits.items()])


def _sights(material: Material, held: str) -> tuple[SightRow, ...]:
    """Four registrations of the same scan under our calibration, made without it."""
    X = estimate_eye_on_base(
        [o for id, o in material.good.items() if id != held], SolveConfig(leave_one_out=False)
    ).X_BC
    chamfered = make_verification(
        material.seen.clouds[held], material.good[held].X_BR, material.standard, max_points=ICP_POINTS
    )
    points, normals = published_model(material.standard, 8000)
    sharp = replace(chamfered, model_R=points, model_normals_R=normals, standard=None)
    kinds: list[tuple[str, Verification]] = [
        ("to points, sharp CAD", sharp),
        ("to planes, sharp CAD", replace(sharp, method="point_to_plane")),
        ("to points, chamfered", chamfered),
        ("to planes, chamfered", replace(chamfered, method="point_to_plane")),
    ]
    rows = []
    for title, v in kinds:
        error = icp_error(X, v)
        rows.append(SightRow(title, error.value, sight(X, v).share, error.unobservable))
    return tuple(rows)


def _path(material: Material, held: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Run once shuffled: e_icp (steps, 6) at the camera and true median error (steps,) m, from scan four on."""
    pairs = [o for o in material.circles if o.id != held]
    state = algorithm1_start(1e-12, 1000)
    verifier = material.verifier(held, "algorithm1")
    steps, true = [], []
    for i in rng.permutation(len(pairs)):
        state = algorithm1_step(state, pairs[i], verifier)
        if len(state.pool) < 4:
            continue
        steps.append(state.error.value)
        inside = {o.id for o in state.pool}
        rest = [o for id, o in material.good.items() if id not in inside and id != held]
        true.append(np.nan if state.X_BC is None else float(np.median(position_errors(state.X_BC, rest))))
    return np.array(steps), np.array(true)
