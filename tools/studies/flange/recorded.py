"""Calibrations of recorded scans: the errors with few of them, with halves, and with two parts of one cloud."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import FlangeNotFound, TooFewPoses
from weldcal.calibration.eye_on_base.few_poses import ENOUGH, axis_turn, calibrate_from_few
from weldcal.calibration.eye_on_base.joint_fit import estimate_jointly, solve_jointly
from weldcal.calibration.eye_on_base.observations import corrected_observation, fit_flanges
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import mean_interval, position_errors, tilt_errors
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.holes import HolePattern
from weldcal.calibration.flange.observation import Observation
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, get_flange
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import fixed, statistics
from weldcal.tools.studies.harness import Figures, Row, Study

PARTS_OF_A_CLOUD = (2, 4, 8)


def study_parts(
    clouds: list[Array], standard: FlangeStandard, *, draws: int = 4, seed: int = 0, progress: Progress = no_progress
) -> list[dict[str, float]]:
    """Divide each cloud (N, 3) m into 2, 4 and 8 random parts and compare the first two. Deterministic for ``seed``.

    Returns a row for each: parts, points in each, rms distance (mm) of two parts' centres, and what the stated
    covariances expect (mm).
    """
    whole: list[Array] = []
    for points in clouds:
        with suppress(FlangeNotFound):
            fit_flange(points, standard)
            whole.append(points)
    rows: list[dict[str, float]] = []
    for parts in PARTS_OF_A_CLOUD:
        apart, stated, size = [], [], []
        for k, points in enumerate(whole):
            if k % 6 == 0:
                progress(
                    f"{parts} parts of each cloud",
                    (PARTS_OF_A_CLOUD.index(parts) + k / len(whole)) / len(PARTS_OF_A_CLOUD),
                )
            for r in range(draws):
                part = np.random.default_rng([seed, k, r]).permutation(len(points)) % parts
                try:
                    a, b = (fit_flange(points[part == i], standard) for i in (0, 1))
                except FlangeNotFound:
                    continue
                apart.append(float(((a.center_C - b.center_C) ** 2).sum()))
                stated.append(float(np.trace(a.center_covariance + b.center_covariance)))
                size.append(len(points) // parts)
        of = {"apart_mm": apart, "stated_mm": stated}
        rms = {name: 1e3 * float(np.sqrt(np.mean(v))) if v else float("nan") for name, v in of.items()}
        rows.append({"parts": parts, "points": int(np.median(size)) if size else 0, **rms})
    return rows


SIZES = (1, 2, 3, 4, 6, 8, 12)
KEPT = 4  # scans that at least are left to judge by
_DRAWS = 2000


def median_sigma(values: Array, seed: int = 0) -> float:
    """Return the bootstrap standard deviation of the median of values (n,)."""
    draws = np.random.default_rng(seed).choice(values, (_DRAWS, len(values)))
    return float(np.median(draws, axis=1).std())


def usable_scans(
    folder: Path, least: int, refusal: str, seed: int, progress: Progress, share: float, *, allow_coplanar: bool = False
) -> tuple[list[Observation], dict[str, HolePattern], RigidTransform]:
    """Observations of a dataset without outliers, the hole patterns by their ids, and a rough X_BC.

    Raises InputError for a folder that is no dataset, TooFewPoses with `refusal` below `least` scans.
    """
    data = load_dataset(folder)
    standard = get_flange(data.header.flange)
    seen = fit_flanges(data, standard, seed=seed, tell=lambda done: progress("fitting flanges", share * done))
    if len(seen.observations) < least:
        raise TooFewPoses(f"{refusal}, and there are {len(seen.observations)}.")
    config = SolveConfig(seed=seed, allow_coplanar=allow_coplanar, leave_one_out=False)
    rough = estimate_eye_on_base(seen.observations, config)
    good = [o for o, keep in zip(seen.observations, rough.inliers, strict=True) if keep]
    return good, dict(seen.patterns), rough.X_BC


@dataclass(frozen=True)
class Draws:
    """Calibrations from ``scans`` random scans each: median error (m) and tilt (rad) on the unused scans.

    NaN where no normals are known; how many were refused, and the share of the others that corrected the scanner.
    """

    scans: int
    position_m: Array
    tilt_rad: Array
    refused: int
    corrected: float


def study_few_scans(
    folder: Path, draws: int = 60, seed: int = 0, sizes: Sequence[int] = SIZES, progress: Progress = no_progress
) -> list[Draws]:
    """Return one row a size, as long as KEPT scans remain.

    From one scan the pose rests on the turn of the drilled holes about the flange's axis, which is known from a
    calibration with all scans. Raises InputError for a folder that is none, TooFewPoses where nothing remains.
    """
    refusal = f"Draws need {ENOUGH + KEPT} usable scans and more"
    good, patterns, X_rough = usable_scans(folder, ENOUGH + KEPT, refusal, seed, progress, 0.3, allow_coplanar=True)
    known = any(o.id in patterns and patterns[o.id].turn_known for o in good)
    turn = axis_turn(good, patterns, X_rough)[0] if known else None
    sizes = [n for n in sizes if n <= len(good) - KEPT and (n > 1 or turn is not None)]
    rng = np.random.default_rng(seed)
    rows = []
    for k, n in enumerate(sizes):
        errors, tilts, corrected = [], [], 0
        first = [i for i, o in enumerate(good) if n > 1 or o.id in patterns]
        for d in range(draws):
            progress(f"{n} scans", 0.3 + 0.7 * (k + d / draws) / len(sizes))
            drawn = set(rng.choice(first, n, replace=False).tolist())
            used, kept = ([o for i, o in enumerate(good) if (i in drawn) == mine] for mine in (True, False))
            try:
                X, correction = _calibrated(used, patterns, turn, seed)
            except InputError:
                continue
            judged = [corrected_observation(correction, o) for o in kept]
            errors.append(float(np.median(position_errors(X, judged))))
            tilt = tilt_errors(X, judged)
            tilts.append(float(np.median(tilt[np.isfinite(tilt)])) if np.isfinite(tilt).any() else float("nan"))
            corrected += correction != ScannerCorrection()
        rows.append(Draws(n, np.array(errors), np.array(tilts), draws - len(errors), corrected / max(len(errors), 1)))
    return rows


def _calibrated(
    used: list[Observation], patterns: Mapping[str, HolePattern], turn: float | None, seed: int
) -> tuple[RigidTransform, ScannerCorrection]:
    """As `weldcal calibrate` does it with so many."""
    if len(used) < ENOUGH:
        alone = len(used) == 1
        return calibrate_from_few(used, patterns, turn if alone else None, seed=seed).X_BC, ScannerCorrection()
    return solve_jointly(used, patterns, seed=seed)


LEAST_HALVES = 16
"""Scans of a recording from which on its halves are calibrated; eight are the least with a choice of the scanner's
correction."""


def study_halves(folder: Path, draws: int = 20, seed: int = 0, progress: Progress = no_progress) -> dict[str, Any]:
    """Calibrate from ``draws`` random halves of a dataset, choices included, and measure on the others.

    Deterministic for ``seed``.

    Returns means of the stated held-out error and of the error on the other half (mm), how many of the latter lie in
    the interval (95 %) that the first half states, and how many halves fixed no calibration (``skipped``).

    Raises InputError for a folder that is none, TooFewPoses for fewer than sixteen usable scans.
    """
    good, patterns, _ = usable_scans(
        folder, LEAST_HALVES, f"Halves need {LEAST_HALVES} usable scans and more", seed, progress, 0.1
    )
    half, rows, skipped = len(good) // 2, [], 0
    for k in range(draws):
        progress("halves", 0.1 + 0.9 * k / draws)
        order = np.random.default_rng([seed, k]).permutation(len(good))
        ours, others = ([good[i] for i in part] for part in (order[:half], order[half:]))
        try:
            X_BC, correction = solve_jointly(ours, patterns, seed=seed)
            new_scans = [corrected_observation(correction, o) for o in others]
            config = SolveConfig(seed=seed, allow_coplanar=True)
            errors = estimate_jointly(ours, patterns, config=config)[0].held_out.position_m
        except InputError:
            skipped += 1
            continue
        interval = mean_interval(errors)
        new = float(np.mean(position_errors(X_BC, new_scans)))
        within = interval is not None and interval[0] < new < interval[1]
        rows.append((float(np.nanmean(errors)), new, float(within)))
    table = np.array(rows).reshape(-1, 3)
    stated, new = (float(1e3 * table[:, k].mean()) if len(table) else float("nan") for k in (0, 1))
    inside = int(table[:, 2].sum())
    return {"draws": draws, "scans": half, "stated_mm": stated, "new_mm": new, "inside": inside, "skipped": skipped}


DatasetArgument = Annotated[Path, typer.Argument(metavar="DATASET", help="A dataset folder with scans.")]


def _few(found: Sequence[Draws], draws: int) -> dict[str, object]:
    rows = []
    for r in (r for r in found if len(r.position_m) > 1):
        of = statistics(1e3 * r.position_m, "median", "p95")
        tilt = float(np.degrees(np.median(r.tilt_rad)))
        row = {"scans": r.scans, "median_mm": of["median"], "median_sigma_mm": 1e3 * median_sigma(r.position_m)}
        rows.append(row | {"p95_mm": of["p95"], "tilt_deg": tilt, "corrected": r.corrected, "refused": r.refused})
    return {"draws": draws, "rows": rows}


def _few_rows(f: Figures) -> Iterable[Row]:
    for r in f["rows"]:
        error = f"{r['median_mm']:.3f} ± {r['median_sigma_mm']:.3f}"
        share = f"{100 * r['corrected']:.0f} %"
        yield str(r["scans"]), error, f"{r['p95_mm']:.3f}", fixed(r["tilt_deg"], 3), share, str(r["refused"])


FEW = Study(
    name="flange-few",
    what="Calibrations from few of the recorded scans, judged on the scans that were not used.",
    header=("scans", "median mm", "95 % mm", "tilt deg", "scanner corrected", "draws refused"),
    rows=_few_rows,
    numbers=5,
)


@command("benchmark flange-few", short_help="Calibrate from 1 to 12 of the scans.", hidden=True)
def few(
    call: Call,
    dataset: DatasetArgument,
    draws: Annotated[int, option("--draws", "N", "Number of random draws of each size.", min=2)] = 60,
) -> Outcome:
    """Calibrate from 1, 2, 3, 4, 6, 8 or 12 of the scans and measure the error on the scans that were not used."""
    folder, found = FEW.folder(call), study_few_scans(dataset, draws, call.seed, progress=call.progress)
    return FEW.found(_few(found, draws), folder)


def _halves_rows(f: Figures) -> Iterable[Row]:
    yield "held-out error stated", f"{f['stated_mm']:.3f} mm mean, from {f['scans']} scans each"
    yield "error on the other half", f"{f['new_mm']:.3f} mm mean"
    yield "in the stated 95 % interval", f"{f['inside']} of {f['draws'] - f['skipped']}"


HALVES = Study(
    name="flange-halves",
    what="The held-out error that random halves of recorded scans state, against the error on the other halves.",
    header=("", "found"),
    rows=_halves_rows,
)


@command("benchmark flange-halves", short_help="Calibrate from random halves of the scans.", hidden=True)
def halves(
    call: Call,
    dataset: DatasetArgument,
    draws: Annotated[int, option("--draws", "N", "Number of random halves.", min=1)] = 20,
) -> Outcome:
    """Calibrate from random halves of the scans: the stated held-out error and its interval, against the error on the
    other half."""
    folder, found = HALVES.folder(call), study_halves(dataset, draws, call.seed, call.progress)
    return HALVES.found(found, folder)


def _part_rows(f: Figures) -> Iterable[Row]:
    for r in f["rows"]:
        yield str(r["points"]), *(f"{r[key]:.3f}" for key in ("apart_mm", "stated_mm"))


PARTS = Study(
    name="flange-parts",
    what="The distance between the flange centres from two parts of one recorded cloud, and the stated one.",
    header=("points each", "apart, rms mm", "stated mm"),
    rows=_part_rows,
    numbers=3,
)


@command("benchmark flange-parts", short_help="Compare flange centres found in two parts of a cloud.", hidden=True)
def parts(call: Call, dataset: DatasetArgument) -> Outcome:
    """Compare the flange centres found in two parts of one cloud: their distance, and the stated one."""
    data = load_dataset(dataset)
    if not data.clouds:
        raise InputError(f"'{dataset}' holds no clouds to divide. Give a dataset with scans.")
    folder, clouds = PARTS.folder(call), [data.cloud(id) for id in data.clouds]
    rows = study_parts(clouds, get_flange(data.header.flange), seed=call.seed, progress=call.progress)
    return PARTS.found({"rows": rows}, folder)
