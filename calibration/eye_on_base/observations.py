"""Fits the flange in every cloud of a dataset; returns observations and the reasons of refused scans."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.eye_on_base.conventions import choose_reading
from weldcal.calibration.flange.fit import FlangeFit, FlangeFitConfig, FlangeGuess, fit_flange
from weldcal.calibration.flange.holes import HolePattern, find_holes
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.published.icp import face_cloud
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

_SEARCH_M = 0.06  # about where a calibration expects the flange; a larger error is searched for in the whole scan


@dataclass(frozen=True, eq=False)
class FlangeObservations:
    """Results of the flange fits: an observation for each usable scan, its fit, its hole pattern where one shows and its face's points
    (N, 3) m by id (none for pairs), and (id, reason) for each scan that is refused."""

    observations: tuple[Observation, ...]
    fits: dict[str, FlangeFit]
    patterns: dict[str, HolePattern]
    clouds: dict[str, Array]
    refused: tuple[tuple[str, str], ...]
    data: Dataset | None = None
    """The dataset with its poses as the scans say that they are to be read; None for pairs."""


def see_flanges(
    data: Dataset,
    standard: FlangeStandard,
    *,
    X_BC: RigidTransform | None = None,
    holes: bool = True,
    seed: int = 0,
    tell: Callable[[float], None] = lambda fraction: None,
) -> FlangeObservations:
    """Fit the flange in every cloud of a dataset, or use its pairs as they are.

    ``X_BC`` is a calibration that says where to look first; a scan in which it leads nowhere is searched whole. Without
    ``holes`` no hole pattern is looked for. Deterministic for ``seed``. ``tell`` is told the fraction done. A damaged file
    is refused with its reason, as is a scan that shows no flange.
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

    def measured(id: str) -> tuple[FlangeFit, HolePattern | None, Array] | CloudError | FlangeNotFound:
        try:
            points = data.cloud(id)
            fit = _fit(points, standard, _guess(data, id, standard, X_BC), seed, whole=X_BC is not None)
        except (CloudError, FlangeNotFound) as refusal:
            return refusal
        return fit, find_holes(points, fit, standard) if holes else None, face_cloud(points, fit, standard)

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
    if len(data.readings) > 1 and observations:
        data = _read_by_scans(data, observations)
        observations = [observation_from_fit(id, data.poses[id], fit, data.X_FR) for id, fit in fits.items()]
    return FlangeObservations(tuple(observations), fits, patterns, clouds, tuple(refused), data)


def _read_by_scans(data: Dataset, observations: list[Observation]) -> Dataset:
    """The dataset with its poses in the reading that the scans select."""
    ids = list(data.poses)
    reading, text = choose_reading(
        data.readings,
        np.array([ids.index(o.id) for o in observations]),
        np.array([o.p_CR for o in observations]),
        np.array([o.n_C for o in observations]),
        data.X_FR.GetAsMatrix4(),
    )
    return data if reading is None else data.read_as(reading, text)


def corrected_observation(correction: ScannerCorrection, o: Observation) -> Observation:
    """An observation with the scanner's correction applied to its centre p_CR (m) and its normal n_C."""
    return replace(
        o,
        p_CR=correction.points(o.p_CR),
        n_C=None if o.n_C is None else correction.normals(np.asarray(o.p_CR), o.n_C),
    )


def _fit(points: Array, standard: FlangeStandard, guess: FlangeGuess | None, seed: int, *, whole: bool) -> FlangeFit:
    config = FlangeFitConfig(seed=seed)
    try:
        return fit_flange(points, standard, guess=guess, config=config)
    except FlangeNotFound:
        if guess is None or not whole:
            raise
        return fit_flange(points, standard, config=config)


def _guess(data: Dataset, id: str, standard: FlangeStandard, X_BC: RigidTransform | None) -> FlangeGuess | None:
    """Where to look in this cloud, where the dataset or a calibration says roughly where the scanner stands."""
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
