"""Compare hand-eye solvers with OpenCV on public data and in simulation."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.geometry.se3 import IDENTITY, as_transform, exp_rotation, inverse, pose
from weldcal.calibration.hand_eye.corners import refine_with_corners
from weldcal.calibration.hand_eye.mountings import MOUNTINGS
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_held_out, opencv_solve
from weldcal.calibration.hand_eye.problem import Loss, Noise, Problem, Scaled, full_problem, linearise
from weldcal.calibration.hand_eye.solve import HandEyeConfig, pose_difference, solve_axb_ycz, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option, switch
from weldcal.tools.cli.subject import one_of
from weldcal.tools.report.render import fixed
from weldcal.tools.studies.hand_eye.cells import hand_eye_cells, mountings
from weldcal.tools.studies.hand_eye.cells import hand_eye_pictures as pictures
from weldcal.tools.studies.hand_eye.conventions import hand_eye_conventions as conventions
from weldcal.tools.studies.harness import Figures, Row, Study, Table
from weldcal.tools.worlds.hand_eye import fuzz

_PLAIN = HandEyeConfig(folds=0)
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
    best_deg_by: str
    best_mm: float
    best_mm_by: str
    flagged: tuple[int, ...]
    unobservable: tuple[str, ...]
    method: str
    low_deg: float = float("nan")
    low_mm: float = float("nan")
    truth_deg: float | None = None
    truth_mm: float | None = None
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

    def summary(self) -> dict[str, Any]:
        """For the last line of --json."""
        return {
            "datasets": {
                r.name: {
                    "held_out_deg": r.deg,
                    "held_out_mm": r.mm,
                    "best_opencv_deg": r.best_deg,
                    "best_opencv_mm": r.best_mm,
                    "lowest_ratio_deg": r.low_deg,
                    "lowest_ratio_mm": r.low_mm,
                    "holds": r.holds,
                    "flagged": list(r.flagged),
                    "unobservable": list(r.unobservable),
                    "truth_nees": r.truth_nees,
                    "truth_nees_corners": r.truth_nees_corners,
                }
                for r in self.rows
            },
            "checks": {k: {"holds": ok, "seen": text} for k, (ok, text) in self.checks.items()},
        }


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
        best_deg_by=by_deg,
        best_mm=mm[by_mm],
        best_mm_by=by_mm,
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
    X = as_transform(truth)
    e = pose_difference(ours.X, X)
    return replace(
        row,
        truth_deg=float(np.degrees(np.linalg.norm(e[:3]))),
        truth_mm=1e3 * float(np.linalg.norm(e[3:])),
        truth_nees=ours.normalised_error("X", X),
    )


def lowest_ratio(ours: Array, theirs: Array, seed: int = 0) -> float:
    """Bound the ratio of two rms errors from below (95 %), by 4,000 paired resamples of the poses."""
    drawn = np.random.default_rng(seed).integers(len(ours), size=(4000, len(ours)))
    ratio = np.sqrt((ours[drawn] ** 2).mean(axis=1) / (theirs[drawn] ** 2).mean(axis=1))
    return float(np.quantile(ratio, 0.025))


def simulated(
    mounting: str, n: int, rng: np.random.Generator, turn: float, shift: float
) -> tuple[Problem, dict[str, Array]]:
    """Sightings of a mounting with noise normal in the target's axes (rad, m), and the truth."""

    def some(k: int, spread: float = 0.8) -> Array:
        return pose(exp_rotation(rng.normal(size=(k, 3)) * spread), rng.normal(size=(k, 3)) * 0.3)

    unknowns = MOUNTINGS[mounting].unknowns
    X, Y = some(2, 1.5)
    Z = some(1, 1.5)[0] if "Z" in unknowns else IDENTITY
    F = some(n)
    H = some(n) if "Z" in unknowns else np.broadcast_to(IDENTITY, (n, 4, 4))
    if mounting == "eye_on_arm_target_on_flange":
        F = inverse(some(n, 0.5)) @ F  # what lies between the two links
    noise = pose(exp_rotation(rng.normal(size=(n, 3)) * turn), rng.normal(size=(n, 3)) * shift)
    G = inverse(F @ X) @ (Y @ H @ Z) @ noise
    problem = full_problem(F, G, H, free=(True, True, "Z" in unknowns))
    return problem, {k: p for k, p in zip("XYZ", (X, Y, Z), strict=True) if k in unknowns}


def coverage(mounting: str, trials: int, n: int = 20, seed: int = 0, progress: Progress = no_progress) -> float:
    """Share of simulated calibrations whose 95 % region of X holds the truth."""
    rng = np.random.default_rng(seed)
    held = 0
    for k in range(trials):
        problem, truth = simulated(mounting, n, rng, float(np.radians(0.05)), 2e-4)
        result = solve_problem(problem, config=_PLAIN)
        held += result.normalised_error("X", as_transform(truth["X"])) < result.region(0.95)
        progress(mounting, (k + 1) / trials)
    return held / trials


def outliers(seed: int) -> tuple[bool, float]:
    """30 of 100 percent gross outliers: all flagged and no other, and the worst ratio to the clean fit's own error."""
    rng = np.random.default_rng(seed)
    problem, truth = simulated("eye_in_hand", 30, rng, float(np.radians(0.05)), 2e-4)
    bad = np.zeros(30, dtype=bool)
    bad[rng.choice(30, 9, replace=False)] = True
    clean = solve_problem(problem.pick(~bad), config=_PLAIN)
    G = problem.G.copy()
    G[bad] = G[bad] @ pose(exp_rotation(rng.normal(size=(9, 3)) * 0.5), rng.normal(size=(9, 3)) * 0.1)
    dirty = solve_problem(full_problem(problem.F, G), config=_PLAIN)
    ratios = []
    for part in (slice(0, 3), slice(3, 6)):
        e, c = (np.linalg.norm(pose_difference(r.X, as_transform(truth["X"]))[part]) for r in (dirty, clean))
        ratios.append(float(e / c))
    return bool((dirty.inliers == ~bad).all()), max(ratios)


def invariance(seed: int = 0) -> float:
    """Largest relative difference of the answer after a change of unit, of all four frames, and of the order."""
    rng = np.random.default_rng(seed)
    problem, _ = simulated("eye_in_hand", 25, rng, float(np.radians(0.05)), 2e-4)
    base = solve_problem(problem, config=_PLAIN)
    X = base.X.GetAsMatrix4()
    left, hand, camera, target = pose(exp_rotation(rng.normal(size=(4, 3))), rng.normal(size=(4, 3)))
    F, G = problem.F.copy(), problem.G.copy()
    F[:, :3, 3] *= 1e3
    G[:, :3, 3] *= 1e3
    mm = solve_problem(full_problem(F, G), config=_PLAIN).X.GetAsMatrix4()
    mm[:3, 3] /= 1e3
    frames = solve_problem(full_problem(left @ problem.F @ hand, camera @ problem.G @ target), config=_PLAIN)
    order = rng.permutation(25)
    shuffled = solve_problem(problem.pick(order), config=_PLAIN).X.GetAsMatrix4()
    answers = (mm, hand @ frames.X.GetAsMatrix4() @ camera, shuffled)
    return max(float(np.abs(Y - X).max()) for Y in answers) / float(np.linalg.norm(X[:3, 3]))


def three_unknowns(starts: int = 100, seed: int = 0) -> tuple[int, float, float]:
    """Solve AXB = YCZ with 30 poses, 0.1 mm and 0.02 degrees, from random starts.

    Returns how many end within twice the Cramer-Rao bound in all three unknowns, the worst error, and the rms error
    over all starts, both in units of the bound.

    The error of an unknown is the root of its squared error in units of the bound's covariance, per number. (An error
    norm compared with the root of a trace would fail a perfect estimator in 2 of 100 by chance.)
    """
    turn, shift = float(np.radians(0.02)), 1e-4
    ratios = []
    for k in range(starts):
        rng = np.random.default_rng(seed + k)
        problem, truth = simulated("co_manipulation", 30, rng, turn, shift)
        state = (truth["X"], truth["Y"], truth["Z"])
        bound = Scaled(problem, linearise(problem, state, np.zeros(3)), Noise(turn**2, shift**2), Loss.SQUARES).V
        guess = [as_transform(p) for p in pose(Rotation.random(3, rng=rng).as_matrix(), rng.normal(size=(3, 3)))]
        result = solve_axb_ycz(problem.F, problem.G, problem.H, _PLAIN, starts=[(guess[0], guess[1], guess[2])])
        row = []
        for i, name in enumerate("XYZ"):
            e = pose_difference(result.poses[name], as_transform(truth[name]))
            s = slice(6 * i, 6 * i + 6)
            row.append(float(np.sqrt(e @ np.linalg.solve(bound[s, s], e) / 6.0)))
        ratios.append(row)
    table = np.array(ratios)
    return int((table.max(axis=1) < 2.0).sum()), float(table.max()), float(np.sqrt((table**2).mean(axis=0)).max())


def degenerate(seed: int = 0) -> dict[str, str]:
    """Return the error or unobservable direction of undetermined motions; "answer": a number without a warning."""
    rng = np.random.default_rng(seed)
    problem, truth = simulated("eye_in_hand", 20, rng, float(np.radians(0.05)), 2e-4)
    X, Y = truth["X"], truth["Y"]
    noise = pose(exp_rotation(rng.normal(size=(20, 3)) * 1e-3), rng.normal(size=(20, 3)) * 2e-4)

    def seen(F: Array) -> Problem:
        return full_problem(F, inverse(F @ X) @ Y @ noise[: len(F)])

    still, turning = problem.F.copy(), problem.F.copy()
    still[:, :3, :3] = still[0, :3, :3]
    turning[:, :3, :3] = exp_rotation(rng.uniform(-1.0, 1.0, (20, 1)) * [0.0, 0.0, 1.0])
    flat = inverse(pose(np.eye(3), rng.normal(size=(20, 3)) * [0.3, 0.3, 0.0]))
    none = np.zeros(20, dtype=bool)
    points = replace(seen(flat), full=none, normal=none, free=(True, False, False))
    cases = {
        "single axis": (seen(turning), (IDENTITY,) * 3),
        "pure translation": (seen(still), (IDENTITY,) * 3),
        "coplanar points": (points, (IDENTITY, Y, IDENTITY)),
        "two poses": (seen(problem.F[:2]), (IDENTITY,) * 3),
        "repeated poses": (seen(np.repeat(problem.F[:2], 10, axis=0)), (IDENTITY,) * 3),
    }
    out = {}
    for name, (case, known) in cases.items():
        try:
            result = solve_problem(case, known, config=_PLAIN)
        except WeldcalError as e:
            out[name] = type(e).__name__
            continue
        sure = not np.isfinite(result.joint_covariance).all() or not result.unobservable
        out[name] = "answer" if sure else result.unobservable[0].split(" (")[0]
    return out


def speed(n: int = 200, repeats: int = 7, peers: int = 3) -> dict[str, float]:
    """Time each method for ``n`` poses in this process: ms of processor time, best of ``repeats``.

    It is best of ``peers`` for OpenCV. What else runs on the machine does not count.
    """
    problem, _ = simulated("eye_in_hand", n, np.random.default_rng(0), float(np.radians(0.05)), 2e-4)
    tasks: dict[str, Callable[[], object]] = {"weldcal": lambda: solve_problem(problem, config=_PLAIN)}
    tasks |= {m: partial(opencv_solve, m, problem.F, problem.G) for m in METHODS}
    out = {}
    for name, task in tasks.items():
        times = []
        for _ in range(repeats if name == "weldcal" else peers):
            begin = time.process_time()
            task()
            times.append(time.process_time() - begin)
        out[name] = 1e3 * min(times)
    return out


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
        progress(path.parent.name, 0.3 * (k + 1) / len(sets))
    tries = [outliers(seed + k) for k in range(3 if quick else 20)]
    ratio = max(r for _, r in tries)
    report.checks["outliers 30 %"] = (
        all(f for f, _ in tries) and ratio <= 1.2,
        f"{sum(f for f, _ in tries)} of {len(tries)} flagged exactly, worst ratio to the clean fit {ratio:.3f}",
    )
    flagged = [r.flagged for r in report.rows if r.name == "handeye_calib_camodocal"]
    if flagged:
        report.checks["outlier of camodocal"] = (flagged == [(36,)], f"flagged {flagged[0]}")
    verdict = degenerate(seed)
    seen = "; ".join(f"{k}: {v}" for k, v in verdict.items())
    report.checks["degenerate motion"] = ("answer" not in verdict.values(), seen)
    worlds = 3 if quick else 300
    verdicts = fuzz(worlds, seed)
    bad = sum(c["NAN"] + c["WRONG"] for c in verdicts.values())
    wrong = [c for m, c in verdicts.items() if m not in ("none", "target size")]
    named = f"of {sum(sum(c.values()) for c in wrong)} with a mistake {sum(c['named'] for c in wrong)} named"
    report.checks["random worlds"] = (bad == 0, f"{worlds}: {bad} NaN or confident and wrong; {named}")
    relative = invariance(seed)
    report.checks["invariance"] = (relative < 1e-9, f"{relative:.1e} relative")
    starts = 3 if quick else 100
    good, worst, rms = three_unknowns(starts, seed)
    said = f"{good} of {starts} within 2x the bound, worst {worst:.2f}x, rms {rms:.2f}x"
    report.checks["AXB = YCZ"] = (good == starts, said)
    progress("uncertainty", 0.5)
    trials = 12 if quick else 500
    for k, name in enumerate(MOUNTINGS):
        share = coverage(name, trials, seed=seed + k)
        # few trials of a quick run only show gross errors
        low, high = (0.6, 1.0) if quick else (0.91, 0.985)
        report.checks[f"95 % region, {name}"] = (low <= share <= high, f"{100 * share:.1f} % of {trials}")
        progress(name, 0.5 + 0.1 * (k + 1))
    times = speed(200, *((3, 1) if quick else (15, 3)))
    seen = ", ".join(f"{k} {v:.1f} ms" for k, v in times.items())
    report.checks["speed, 200 poses"] = (times["weldcal"] < 20.0, seen)
    return report


def _set_rows(figures: Figures) -> Iterable[Row]:
    for name, r in figures["datasets"].items():
        known = r["best_opencv_deg"] is not None and np.isfinite(r["best_opencv_deg"])
        yield (
            name,
            f"{r['held_out_deg']:.4f}",
            fixed(r["best_opencv_deg"], 4),
            f"{r['held_out_mm']:.3f}",
            fixed(r["best_opencv_mm"], 3),
            ", ".join(map(str, r["flagged"])) or "-",
            "; ".join(r["unobservable"]) or "-",
            ("yes" if r["holds"] else "NO") if known else "-",
            f"{fixed(r['truth_nees'], 1)}, {fixed(r['truth_nees_corners'], 1)}",
        )


def _checks(figures: Figures) -> Iterable[Table]:
    rows = [(name, "yes" if c["holds"] else "NO", c["seen"]) for name, c in figures["checks"].items()]
    yield "In simulation", ("check", "holds", "found"), rows


SETS = Study(
    name="hand-eye",
    what="The hand-eye solvers beside OpenCV's seven methods on public sets, and checks in simulation.",
    rows=_set_rows,
    others=_checks,
    header=(
        "set",
        "held-out deg",
        "best OpenCV",
        "held-out mm",
        "best OpenCV",
        "flagged",
        "open",
        "holds",
        "squared error against the truth, with corners",
    ),
)


@command("benchmark hand-eye-sets", short_help="Compare the hand-eye solvers with OpenCV's on sets.", hidden=True)
def hand_eye_sets(
    call: Call,
    data: Annotated[Path | None, option("--data", "FOLDER", "A folder of sets, each a folder with pairs.npz.")] = None,
    quick: Annotated[bool, switch("--quick", "Few trials of each kind: seconds instead of minutes.")] = False,
) -> Outcome:
    """Compare the hand-eye solvers with OpenCV's on public data, and test them in simulation."""
    folder = SETS.folder(call)
    found = run_hand_eye_benchmark(data, quick=quick, seed=call.seed, progress=call.progress)
    return SETS.found(found.summary(), folder)


@command("benchmark hand-eye", short_help="Compare the hand-eye solvers with OpenCV's.", options=FARM)
@one_of(
    "sets", sets=hand_eye_sets, cells=hand_eye_cells, mountings=mountings, conventions=conventions, pictures=pictures
)
def hand_eye(call: Call) -> None:
    """Compare the hand-eye solvers with OpenCV's on public data (sets) and on imperfect cells (cells), test them in
    simulation, calibrate every mounting live (mountings), read pose lists in random conventions (conventions), and
    calibrate from rendered pictures (pictures).
    """
