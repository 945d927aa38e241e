"""Fit the flange in every cloud of a dataset, and decide how its poses are to be read.

Refused scans have a reason.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import read_header
from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.poses.bag import find_bag
from weldcal.calibration.data.poses.readings import CHANGES, PoseReading, change_of, pick
from weldcal.calibration.data.poses.source import find_poses
from weldcal.calibration.errors import FlangeNotFound, InconsistentPoses
from weldcal.calibration.flange.fit import FlangeFit, FlangeFitConfig, FlangeGuess, face_cloud, fit_flange
from weldcal.calibration.flange.holes import HolePattern, find_holes
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.geometry.robust import OrderFit, Rows, f_quantile, find_order
from weldcal.calibration.geometry.se3 import nearest_rotation
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.models.robots import stated_flange

CHANCE = 1e-6  # a choice: a wrong refusal in a million; a factor of two moves the limit by less than 10 %
"""Chance that the right reading is rejected in favour of a wrong one."""
FEWEST = 5
_KEPT = 0.7  # share of the scans that must agree: the others may be outliers
_OUTLYING = 4.0  # medians of the scans' residuals: without one beyond, all of them count
_LEVER_M = 0.1  # weight of a normal against a centre: an error of 0.1 rad counts as 10 mm
_NORMAL_FLOOR, _CENTRE_FLOOR_M = 2e-5, 2e-6  # printed digits
_AGREE_RAD, _AGREE_SHARE = (
    0.06,
    0.1,
)  # residuals of normals, and of centres against their spread, of a reading that is right
_SAME_M, _SAME_RAD = 1e-3, 2e-3  # results that are the same
_STEPS = 4
_SEARCH_M = 0.06  # about where a calibration expects the flange; a larger error is searched for in the whole scan


FlangeScan = tuple[FlangeFit, HolePattern | None, Array] | CloudError | FlangeNotFound
"""The flange in a cloud, its holes, and the points of its face; or why it is not there."""


@dataclass(frozen=True, eq=False)
class FlangeObservations:
    """Results of the flange fits.

    An observation for each usable scan, its fit, its hole pattern where one shows and its face's points (N, 3) m by id
    (none for pairs), and (id, reason) for each scan that is refused.
    """

    observations: tuple[Observation, ...]
    fits: dict[str, FlangeFit]
    patterns: dict[str, HolePattern]
    clouds: dict[str, Array]
    refused: tuple[tuple[str, str], ...]
    data: Dataset | None = None
    """The dataset with its poses as the scans say that they are to be read; None for pairs."""


def require_flange(folder: Path, flange: str | None, robot: str | None = None) -> None:
    """Check that a dataset's folder or the arguments name a known flange, before any cloud is read.

    Raises InputError, with the usual flange of the robot where none is named.
    """
    description = folder / "dataset.yaml"
    if folder.is_dir() and (description.is_file() or find_poses(folder) or find_bag(folder)):
        header = read_header(description) if description.is_file() else DatasetHeader()
        stated_flange(flange or header.flange, robot or header.robot)


def flange_scan(
    points: Array,
    standard: FlangeStandard,
    guess: FlangeGuess | None = None,
    seed: int = 0,
    *,
    whole: bool = False,
    holes: bool = True,
) -> FlangeScan:
    """Find the flange in a cloud (N, 3) or (H, W, 3), m; ``whole``: a guess that leads nowhere is not the end."""
    try:
        fit = _fit(points, standard, guess, seed, whole=whole)
    except FlangeNotFound as refusal:
        return refusal
    return fit, find_holes(points, fit, standard) if holes else None, face_cloud(points, fit, standard)


def fit_flanges(
    data: Dataset,
    standard: FlangeStandard,
    *,
    X_BC: RigidTransform | None = None,
    guesses: Mapping[str, FlangeGuess] | None = None,
    holes: bool = True,
    seed: int = 0,
    tell: Callable[[float], None] = lambda fraction: None,
    known: dict[str, FlangeScan] | None = None,
) -> FlangeObservations:
    """Fit the flange in every cloud of a dataset, or use its pairs as they are.

    ``X_BC`` is a calibration that says where to look first; a scan in which it leads nowhere is searched whole.
    ``guesses`` says it scan by scan instead. Without ``holes`` no hole pattern is looked for. Deterministic for
    ``seed``. ``tell`` is told the fraction done. A damaged file is refused with its reason, as is a scan that shows no
    flange. ``known`` holds what was found in clouds before, by id, and takes what is found now.
    """
    if data.pairs:
        return FlangeObservations(
            tuple(Observation(p.id, p.X_BR, p.p_CR) for p in data.pairs), {}, {}, {}, data.refused
        )
    observations: list[Observation] = []
    fits: dict[str, FlangeFit] = {}
    patterns: dict[str, HolePattern] = {}
    clouds: dict[str, Array] = {}
    refused = list(data.refused)

    known = {} if known is None else known

    def measured(id: str) -> FlangeScan:
        if id not in known:
            known[id] = fitted(id)
        return known[id]

    def fitted(id: str) -> FlangeScan:
        try:
            guess = _guess(data, id, standard, X_BC) if guesses is None else guesses[id]
            return flange_scan(data.cloud(id), standard, guess, seed, whole=X_BC is not None, holes=holes)
        except CloudError as refusal:
            return refusal

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # reading and fitting leave the interpreter most of the time
        for k, (id, found) in enumerate(zip(data.clouds, pool.map(measured, data.clouds), strict=True)):
            tell(k / len(data.clouds))
            if isinstance(found, CloudError | FlangeNotFound):
                refused.append((id, found.reason))
                continue
            fits[id], pattern, clouds[id] = found
            if pattern is not None:
                patterns[id] = pattern
            observations.append(observation_from_fit(id, data.poses[id], fits[id], data.X_FR))
    if data.in_order and observations:
        data = _in_found_order(data, observations)
        observations = [observation_from_fit(id, data.poses[id], fit, data.X_FR) for id, fit in fits.items()]
    if len(data.readings) > 1 and observations:
        data = _read_by_scans(data, observations)
        observations = [observation_from_fit(id, data.poses[id], fit, data.X_FR) for id, fit in fits.items()]
    return FlangeObservations(tuple(observations), fits, patterns, clouds, tuple(refused), data)


def _in_found_order(data: Dataset, observations: list[Observation]) -> Dataset:
    """Return the dataset with its poses in the order that the scans show, where they contradict the present one.

    Distances of centres are the same in the base and the camera, whatever X_BC is.

    Raises InconsistentPoses where some scans may belong to several poses.
    """
    every = data.readings or (PoseReading("", "", np.array([X.GetAsMatrix4() for X in data.poses.values()])),)
    X_FR, ids = data.X_FR.GetAsMatrix4(), list(data.poses)
    p_CR, n_C = np.array([o.p_CR for o in observations]), np.array([o.n_C for o in observations])
    present = np.array([ids.index(o.id) for o in observations])
    if any(_agreement(one, present, p_CR, n_C, X_FR, False).agrees for one in every):
        return data

    def solve(_: int, __: int, pairs: tuple[Rows, Rows]) -> OrderFit:
        tried = [_agreement(one, pairs[0], p_CR[pairs[1]], n_C[pairs[1]], X_FR, False) for one in every]
        one = min(tried, key=_cost)
        X = one.reading.X @ X_FR
        off, tilt = X[:, None, :3, 3] - (p_CR @ one.R.T + one.p), X[:, None, :3, 2] - n_C @ one.R.T
        off2, turn2 = (off**2).sum(axis=2), (tilt**2).sum(axis=2)
        return OrderFit(turn2=turn2, off2=off2, turn=1.0, extent=one.spread, agrees=one.agrees)

    p_BR = (every[0].X @ X_FR)[:, :3, 3]
    found = find_order([_distances(p_BR)], [_distances(p_CR)], solve, every[0].X)
    if found is None or 2 * len(found.unclear) > len(found.first):
        return data
    if found.unclear:
        rows = ", ".join(str(k + 1) for k in found.unclear)
        raise InconsistentPoses(
            f"The scans and the poses of '{data.folder.name}' are not in the same order. The scans show the order of"
            f" all poses but {rows}. Add a column 'id' with the clouds' names, or remove these scans and poses."
        )
    rows_of = {int(present[k]): row for row, k in found.partners().items()}
    rows_of |= dict(
        zip(
            sorted(set(range(len(ids))) - set(rows_of)),
            sorted(set(range(len(ids))) - set(rows_of.values())),
            strict=True,
        )
    )
    order = [rows_of[k] for k in range(len(ids))]
    words = ", ".join(f"{id} to row {row + 1}" for id, row in list(zip(ids, order, strict=True))[:12])
    note = f"The clouds belong to the poses in another order: {words}. The distances between the flanges show it."
    moved = {id: (data.poses[ids[row]], data.angles.get(ids[row], {})) for id, row in zip(ids, order, strict=True)}
    return replace(
        data,
        poses={id: X for id, (X, _) in moved.items()},
        angles={id: q for id, (_, q) in moved.items()},
        readings=tuple(pick(data.readings, np.array(order))),
        notes=(*data.notes, note),
    )


def _distances(p: Array) -> Array:
    """Distances (n, n) of points (n, 3)."""
    return np.asarray(np.linalg.norm(p[:, None] - p, axis=2))


def _read_by_scans(data: Dataset, observations: list[Observation]) -> Dataset:
    """Return the dataset with its poses in the reading that the scans select."""
    ids = list(data.poses)
    reading, text = choose_reading(
        data.readings,
        np.array([ids.index(o.id) for o in observations]),
        np.array([o.p_CR for o in observations]),
        np.array([o.n_C for o in observations]),
        data.X_FR.GetAsMatrix4(),
    )
    return data if reading is None else data.read_as(reading, text)


def _fit(points: Array, standard: FlangeStandard, guess: FlangeGuess | None, seed: int, *, whole: bool) -> FlangeFit:
    config = FlangeFitConfig(seed=seed)
    try:
        return fit_flange(points, standard, guess=guess, config=config)
    except FlangeNotFound:
        if guess is None or not whole:
            raise
        return fit_flange(points, standard, config=config)


def _guess(data: Dataset, id: str, standard: FlangeStandard, X_BC: RigidTransform | None) -> FlangeGuess | None:
    """Return where to look in this cloud, if the dataset or a calibration gives the scanner's approximate pose."""
    X_CR, reach = data.guess(id), _SEARCH_M
    if X_CR is not None and data.header.scanner_guess is not None:
        reach = data.header.scanner_guess.radius_m
    elif X_BC is not None:
        X_CR = X_BC.InvertAndCompose(data.poses[id] @ data.X_FR)
    if X_CR is None:
        return None
    return FlangeGuess(
        center_C=np.asarray(X_CR.translation()),
        radius_m=reach + 0.5 * standard.outer_m,
        normal_C=X_CR.rotation().matrix()[:, 2],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanAgreement:
    """How well the scans agree with a reading.

    Rms angle of the normals (rad) and distance of the centres (m) of so many scans that are no outliers, the spread of
    the centres (m), R_BC and p_BC, and whether a list is changed beyond what is stated.
    """

    reading: PoseReading
    scans: int
    normal: float
    centre: float
    spread: float
    R: Array
    p: Array
    changed: bool

    @property
    def agrees(self) -> bool:
        """Whether the residuals are those of a working cell."""
        return self.normal < _AGREE_RAD and self.centre < _AGREE_SHARE * self.spread


def choose_reading(
    readings: Sequence[PoseReading], rows: Rows, p_CR: Array, n_C: Array, X_FR: Array
) -> tuple[PoseReading | None, str]:
    """Return the reading of the flange poses with which the scans agree, and a sentence about it.

    None where the usual one stands.

    Centres of the feature in the base do not depend on the notation of rotations, its normals do. For each reading the
    rigid X_BC that fits centres and normals best leaves residuals of normals with at least 2 m - 3 degrees of freedom,
    m of the n scans being no outliers, and more of centres. A reading whose residuals exceed those of the best by more
    than the quantile of F(2 m - 3, 2 m - 3) for CHANCE is rejected.

    Args:
        readings: poses X_BF (N, 4, 4) in metres, the usual reading first.
        rows: the poses (n) of the scans that show the flange.
        p_CR, n_C: centres (n, 3) m and normals (n, 3) of the feature in the camera.
        X_FR: pose (4, 4) of the feature in the flange.

    Raises:
        InconsistentPoses: several readings agree and their results differ.
    """
    n = len(rows)
    if n < FEWEST:
        return None, ""
    tried = [_agreement(one, rows, p_CR, n_C, X_FR, False) for one in readings]
    changes = [
        _agreement(one.changed(change), rows, p_CR, n_C, X_FR, True)
        for one in readings
        for change in CHANGES
        if change != "left_handed"
    ]
    best = min(tried + changes, key=_cost)
    dof = max(2 * best.scans - 3, 3)
    limit = float(np.sqrt(f_quantile(1.0 - CHANCE / (2.0 * len(tried + changes)), dof, dof)))
    firm = [one for one in tried if not one.reading.doubted]
    if len(firm) < len(tried):
        usual = min(firm, key=_cost)
        if usual.agrees and not _rejected(usual, best, limit):
            best, tried, changes = usual, firm, []
    if best.changed:
        plain = min(tried, key=_cost)
        if plain.agrees and not _rejected(plain, best, limit):
            best = plain
    if not best.agrees:
        return None, ""
    pool = tried + changes if best.changed else tried
    alive = [one for one in pool if one is not best and one.agrees and not _rejected(one, best, limit)]
    rivals = [one for one in alive if not _same(one, best)]
    if rivals and best.reading.form != readings[0].form:
        first = next((one for one in alive if one.reading.form == readings[0].form), None)
        if first is not None and not rivals[1:] and _same(first, best):
            rivals = []
    if rivals:
        other = min(rivals, key=_cost)
        raise InconsistentPoses(
            f"The scans agree with the poses in more than one reading, and the results differ: {best.reading.words}"
            f" ({_residual(best)}), or {other.reading.words} ({_residual(other)}). State the right one in dataset.yaml:"
            f" {_statement(best.reading.form)}, or {_statement(other.reading.form)}."
        )
    by = change_of(best.reading, readings)
    if by is not None and not best.reading.form.endswith(by):
        raise InconsistentPoses(
            f"The poses are stated as {by}, and the scans agree with them only if they are not ({_residual(best)})."
            f" State {_statement(best.reading.form)} in dataset.yaml."
        )
    dead = [one for one in tried if one is not best and one not in alive]
    text = f"Poses read as {best.reading.words}: {_residual(best)}"
    text += f"; the next best reading leaves {_residual(min(dead, key=_cost))}." if dead else "."
    return best.reading, text


def _statement(form: str) -> str:
    words = form.split(",")
    rotation = ",".join([words[0], *(w for w in words[1:] if w in ("transposed", "left_handed"))])
    parts = [f"rotation: '{rotation}'" if "," in rotation else f"rotation: {rotation}"]
    parts += [f"angles: {w}" for w in words[1:] if w in ("deg", "rad")]
    parts += ["frame: base_in_flange" for w in words[1:] if w == "inverse"]
    return f"'poses: {{{', '.join(parts)}}}'"


def _residual(one: ScanAgreement) -> str:
    return f"normals {np.degrees(one.normal):.3g} degrees, centres {1e3 * one.centre:.3g} mm"


def _cost(one: ScanAgreement) -> float:
    return float(np.log(one.normal) + np.log(one.centre / one.spread))


def _rejected(one: ScanAgreement, best: ScanAgreement, limit: float) -> bool:
    return one.normal > limit * best.normal or one.centre / one.spread > limit * best.centre / best.spread


def _same(one: ScanAgreement, other: ScanAgreement) -> bool:
    turn = float(np.linalg.norm(one.R - other.R)) / np.sqrt(2.0)
    return turn < max(_SAME_RAD, 2.0 * other.normal) and float(np.linalg.norm(one.p - other.p)) < max(
        _SAME_M, 3.0 * other.centre
    )


def _agreement(reading: PoseReading, rows: Rows, p_CR: Array, n_C: Array, X_FR: Array, changed: bool) -> ScanAgreement:
    X = reading.X[rows] @ X_FR
    p_B, n_B = X[:, :3, 3], X[:, :3, 2]
    n = len(rows)
    kept = max(int(np.ceil(_KEPT * n)), min(n, 4))
    weight = np.ones(n)
    for _ in range(_STEPS):
        w = weight[:, None]
        middle_B, middle_C = (w * p_B).sum(axis=0) / w.sum(), (w * p_CR).sum(axis=0) / w.sum()
        R = nearest_rotation((w * (p_B - middle_B)).T @ (p_CR - middle_C) + _LEVER_M**2 * (w * n_B).T @ n_C)
        off = np.linalg.norm((p_B - middle_B) - (p_CR - middle_C) @ R.T, axis=1)
        tilt = np.linalg.norm(n_B - n_C @ R.T, axis=1)
        size = np.hypot(off / _LEVER_M, tilt)
        cut = np.sort(size)[kept - 1] + 1e-9
        weight = np.minimum(1.0, (1.5 * cut / np.maximum(size, 1e-12)) ** 2)
    if size.max() < _OUTLYING * np.median(size):
        kept = n
    return ScanAgreement(
        reading=reading,
        scans=kept,
        normal=float(np.sqrt((np.sort(tilt)[:kept] ** 2).mean())) + _NORMAL_FLOOR,
        centre=float(np.sqrt((np.sort(off)[:kept] ** 2).mean())) + _CENTRE_FLOOR_M,
        spread=float(np.sqrt(p_B.var(axis=0).sum())) + 1e-9,
        R=R,
        p=middle_B - R @ middle_C,
        changed=changed,
    )
