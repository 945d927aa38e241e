"""Count how often data choose the right reading of two pose lists, and reject a right one by chance."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.readings import PoseReading, readings
from weldcal.calibration.geometry.robust import f_quantile
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.calibration.hand_eye.pairs.conventions import ReadingDecision, agreements, decide
from weldcal.tools.cli.options import FARM, Call, Outcome, command, option
from weldcal.tools.studies.harness import Figures, Results, Row, Study, Table
from weldcal.tools.worlds.hand_eye import WrittenSet, written_set

SIGMAS = 6.0
"""Without noise, the residual of the next reading in units of the noise, from which on the data determine the
reading."""
TAILS = (1e-2, 1e-3, 1e-4)
_BLOCK = 200
_NEAR_SIGMAS = 8.0  # of X: a reading that is written otherwise and gives the same result
_FEW = (6, 10, 20)


def conventions(kind: str, seed: int, n: int = 0, runs: int = 0) -> Mapping[str, object]:
    """Read one set in random conventions, or test ``runs`` readings that are equally right, of ``n`` poses."""
    rng = np.random.default_rng(seed)
    return _chosen(written_set(rng)) if kind == "set" else _tail(rng, n, runs)


def _chosen(case: WrittenSet) -> Mapping[str, object]:
    robot = readings(case.robot)
    found = decide(robot, readings(case.camera), eye_in_hand=True)
    clean = decide(robot, readings(case.exact), eye_in_hand=True)
    best = found.best
    forms = best.robot.form, best.camera.form
    right = forms == case.forms or _near(found, case)
    return {
        "written": list(case.forms),
        "read": list(forms),
        "n": len(case.robot.p),
        "determined": _determined(clean, case),
        "used": found.determined and best.agrees,
        "right": right,
        "unit": best.unit_scale is not None and abs(np.log(best.unit_scale / case.unit_ratio)) < 0.01,
    }


def _determined(clean: ReadingDecision, case: WrittenSet) -> bool:
    """Return whether the next reading that leads to another result leaves residuals over SIGMAS of the noise."""
    others = [one for one in (*clean.rivals, clean.next) if one is not None]
    return all(max(one.rotation / case.rotation, one.position / case.position) > SIGMAS for one in others)


def _near(found: ReadingDecision, case: WrittenSet) -> bool:
    """Return whether X is within the errors that the noise causes."""
    n, best = len(case.robot.p), found.best
    turn = Rotation.from_matrix(best.X[:3, :3].T @ case.X[:3, :3]).magnitude()
    shift = float(np.linalg.norm(best.X[:3, 3] / case.scale - case.X[:3, 3]))
    spread = max(best.turn, 1e-3)
    sigma = case.rotation / np.sqrt(n) / min(spread, 1.0)
    moved = (case.position / case.scale + case.rotation) / np.sqrt(n) / min(spread, 1.0)
    return bool(turn < _NEAR_SIGMAS * sigma + 1e-4 and shift < _NEAR_SIGMAS * moved + 1e-4)


def _tail(rng: np.random.Generator, n: int, runs: int) -> Mapping[str, object]:
    """Count how often one of two right readings exceeds the other by each limit, in rotations and positions."""
    counts, compared = np.zeros(len(TAILS), dtype=int), 0
    for _ in range(max(runs // _BLOCK, 1)):
        turned = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.5)
        A = pose(turned.as_matrix(), rng.uniform(-0.3, 0.3, (n, 3)))
        X, Y = pose(Rotation.random(2, rng=rng).as_matrix(), rng.normal(size=(2, 3)) * 0.2)
        B = inverse(X) @ inverse(A) @ Y
        tried = []
        for _ in range(_BLOCK):
            noise = pose(
                Rotation.from_rotvec(rng.normal(size=(n, 3)) * 2e-3).as_matrix(), rng.normal(size=(n, 3)) * 1e-3
            )
            tried.append((PoseReading("a", "a", A), PoseReading("b", "b", B @ noise), 0))
        found = agreements(tried, eye_in_hand=True)
        size = np.array([(one.rotation, one.position) for one in found])
        ratio = size[0::2] / size[1::2]
        dof = found[0].dof
        counts += [int((ratio > np.sqrt(f_quantile(1.0 - tail, dof, dof))).sum()) for tail in TAILS]
        compared += ratio.size
    return {"n": n, "compared": compared, "beyond": counts.tolist()}


def _counts(results: Results) -> Figures:
    sets = {name: one for name, one in results.items() if "written" in one}
    determined = [one for one in sets.values() if one["determined"]]
    used = [one for one in sets.values() if one["used"]]
    wrong = {name: one for name, one in sets.items() if one["used"] and not one["right"]}
    tails = []
    for n in sorted({one["n"] for one in results.values() if "beyond" in one}):
        mine = [one for one in results.values() if "beyond" in one and one["n"] == n]
        compared = sum(one["compared"] for one in mine)
        tails.append(
            {
                "n": n,
                "compared": compared,
                "share": (np.sum([one["beyond"] for one in mine], axis=0) / compared).tolist(),
            }
        )
    return {
        "sets": len(sets),
        "determined": len(determined),
        "right_of_determined": sum(one["used"] and one["right"] for one in determined),
        "used": len(used),
        "wrong": len(wrong),
        "wrong_units": sum(not one["unit"] for one in used),
        "wrong_sets": {name: [one["written"], one["read"]] for name, one in list(wrong.items())[:10]},
        "missed_sets": {
            name: [one["written"], one["read"]]
            for name, one in sets.items()
            if one["determined"] and not (one["used"] and one["right"])
        },
        "tails": tails,
    }


def _rows(figures: Figures) -> Iterable[Row]:
    share = 100.0 * figures["right_of_determined"] / max(figures["determined"], 1)
    yield (
        f"{figures['sets']}",
        f"{figures['determined']}",
        f"{share:.2f} %",
        f"{figures['used']}",
        f"{figures['wrong']}",
        f"{figures['wrong_units']}",
    )


def _tail_rows(figures: Figures) -> Iterable[Table]:
    rows = [(f"{t['n']}", f"{t['compared']}", *(f"{v:.1e}" for v in t["share"])) for t in figures["tails"]]
    yield (
        "A right reading rejected in favour of another",
        ("poses", "comparisons", *(f"chance {t:g}" for t in TAILS)),
        rows,
    )


STUDY = Study(
    name="hand-eye-conventions",
    what=(
        "Two lists of poses in random conventions: how often the data determine the reading, and the right one is used."
    ),
    case=conventions,
    figures=_counts,
    header=("sets", "determined", "right of these", "used", "wrong", "wrong units"),
    rows=_rows,
    others=_tail_rows,
)


@command("benchmark hand-eye-conventions", short_help="Count right readings of pose lists.", hidden=True, options=FARM)
def hand_eye_conventions(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Number of sets.", min=1)] = 1000,
    tails: Annotated[
        int, option("--tails", "N", "Number of comparisons of right readings, for each number of poses.", min=0)
    ] = 20_000,
) -> Outcome:
    """Write two lists of poses in random conventions and count how often the right reading, and how often a wrong one,
    is used."""
    cases: dict[str, dict[str, Any]] = {
        f"set {s}": {"kind": "set", "seed": s} for s in range(call.seed, call.seed + runs)
    }
    for n in _FEW if tails else ():
        cases[f"tail of {n} poses"] = {"kind": "tail", "seed": call.seed, "n": n, "runs": tails}
    return STUDY.outcome(call, cases)
