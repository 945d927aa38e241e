"""Compare hand-eye solvers with OpenCV on public data and in simulation."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.hand_eye import fuzz
from weldcal.calibration.geometry.se3 import as_transform
from weldcal.calibration.hand_eye.corners import refine_with_corners
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.render import fixed

_SHARE = 0.02  # by which a method must be better to count as ahead


@dataclass(frozen=True, kw_only=True)
class DatasetRow:
    """One set of others: held-out deg and mm, OpenCV's best of each column, what was flagged and left open.

    ``low_deg``, ``low_mm``: lower ends of the paired bootstrap 95 % intervals of ours over OpenCV's best.
    """

    name: str
    n: int
    deg: float
    mm: float
    best_deg: float
    best_mm: float
    flagged: tuple[int, ...]
    unobservable: tuple[str, ...]
    method: str
    low_deg: float = float("nan")
    low_mm: float = float("nan")
    truth_nees: float | None = None
    truth_nees_corners: float | None = None
    corners: str = ""

    @property
    def holds(self) -> bool:
        """Whether OpenCV is nowhere ahead in a column by more than 2 % beyond chance; never without OpenCV."""
        return all(
            ours <= theirs * (1.0 + _SHARE) or low <= 1.0 + _SHARE
            for ours, theirs, low in ((self.deg, self.best_deg, self.low_deg), (self.mm, self.best_mm, self.low_mm))
        )


@dataclass
class HandEyeBenchmark:
    """Hold all rows; ``checks``: name -> (held, what was found)."""

    rows: list[DatasetRow] = field(default_factory=list)
    checks: dict[str, tuple[bool, str]] = field(default_factory=dict)


def dataset_row(name: str, F: Array, G: Array, truth: Array | None, *, opencv: bool = True) -> DatasetRow:
    """Ours and OpenCV's on poses F X G = Y, held out on the same folds; without ``opencv`` its columns are NaN."""
    # each sample counts, repeats too, as in the figures that were published with the sets
    ours = solve_problem(full_problem(F, G), config=HandEyeConfig(join_repeats=False))
    theirs = {m: opencv_held_out(m, F, G, observation=np.arange(len(F))) for m in METHODS} if opencv else {}
    none = {"-": float("nan")}
    deg = {m: h.rms_deg for m, h in theirs.items() if np.isfinite(h.rotation_rad).all()} or none
    mm = {m: 1e3 * h.rms_translation for m, h in theirs.items() if np.isfinite(h.translation).all()} or none
    by_deg, by_mm = min(deg, key=lambda m: deg[m]), min(mm, key=lambda m: mm[m])
    row = DatasetRow(
        name=name,
        n=len(F),
        deg=ours.held_out.rms_deg,
        mm=1e3 * ours.held_out.rms_translation,
        best_deg=deg[by_deg],
        best_mm=mm[by_mm],
        flagged=tuple(int(i) for i in np.nonzero(~ours.inliers)[0]),
        unobservable=ours.unobservable,
        method=ours.method,
    )
    if opencv:
        row = replace(
            row,
            low_deg=lowest_ratio(ours.held_out.rotation_rad, theirs[by_deg].rotation_rad),
            low_mm=lowest_ratio(ours.held_out.translation, theirs[by_mm].translation),
        )
    if truth is None:
        return row
    return replace(row, truth_nees=ours.normalised_error("X", as_transform(truth)))


def lowest_ratio(ours: Array, theirs: Array, seed: int = 0) -> float:
    """Bound the ratio of two rms errors from below (95 %), by 4,000 paired resamples of the poses."""
    drawn = np.random.default_rng(seed).integers(len(ours), size=(4000, len(ours)))
    ratio = np.sqrt((ours[drawn] ** 2).mean(axis=1) / (theirs[drawn] ** 2).mean(axis=1))
    return float(np.quantile(ratio, 0.025))


def run_hand_eye_benchmark(
    data: Path | None, *, quick: bool = False, seed: int = 0, progress: Progress = no_progress
) -> HandEyeBenchmark:
    """Run all of it.

    ``data``: folder of sets (pairs.npz each), None to leave them out; ``quick``: few trials and no OpenCV on the
    sets, for a test. Raises InputError, before any work, where the folder holds no set.
    """
    from weldcal.calibration.hand_eye.pairs.files import read_pairs

    report = HandEyeBenchmark()
    sets = sorted(data.glob("*/pairs.npz")) if data is not None else []
    if data is not None and not sets:
        raise InputError(f"'{data}' holds no sets: give a folder of folders, each with a pairs.npz.")
    for k, path in enumerate(sets):
        pairs = read_pairs(path)
        row = dataset_row(path.parent.name, pairs.F, pairs.G, pairs.X_true, opencv=not quick)
        if pairs.X_true is not None and pairs.img is not None:
            try:
                refined = refine_with_corners(pairs)
            except WeldcalError as problem:
                row = replace(row, corners=f"Corners: not used. {problem}")
            else:
                nees = refined.result.normalised_error("X", as_transform(pairs.X_true))
                row = replace(row, truth_nees_corners=nees, corners=refined.sentence)
        report.rows.append(row)
        progress(path.parent.name, 0.9 * (k + 1) / len(sets))
    flagged = [r.flagged for r in report.rows if r.name == "handeye_calib_camodocal"]
    if flagged:
        report.checks["outlier of camodocal"] = (flagged == [(36,)], f"flagged {flagged[0]}")
    worlds = 3 if quick else 300
    verdicts = fuzz(worlds, seed)
    bad = sum(c["NAN"] + c["WRONG"] for c in verdicts.values())
    wrong = [c for m, c in verdicts.items() if m not in ("none", "target size")]
    named = f"of {sum(sum(c.values()) for c in wrong)} with a mistake {sum(c['named'] for c in wrong)} named"
    report.checks["random worlds"] = (bad == 0, f"{worlds}: {bad} NaN or confident and wrong; {named}")
    return report


@figure("hand-eye", "the hand-eye solvers beside OpenCV's seven methods on public sets (--data), and in simulation")
def hand_eye(run: Run) -> None:
    """Compare the solvers with OpenCV's on public data, and test them in simulated worlds."""
    found = run_hand_eye_benchmark(run.data, quick=not run.full, seed=run.seed, progress=run.progress)
    rows = (
        (
            *(r.name, f"{r.deg:.4f}", fixed(r.best_deg, 4), f"{r.mm:.3f}", fixed(r.best_mm, 3)),
            *(", ".join(map(str, r.flagged)) or "-", "; ".join(r.unobservable) or "-"),
            ("yes" if r.holds else "NO") if np.isfinite(r.best_deg) else "-",
            f"{fixed(r.truth_nees, 1)}, {fixed(r.truth_nees_corners, 1)}",
        )
        for r in found.rows
    )
    held = ("held-out deg", "best OpenCV", "held-out mm", "best OpenCV")
    run.table("", ("set", *held, "flagged", "open", "holds", "squared error against the truth, with corners"), rows)
    checks = ((name, "yes" if ok else "NO", text) for name, (ok, text) in found.checks.items())
    run.table("In simulation", ("check", "holds", "found"), checks)
