"""Generated lists of poses whose rows do not pair in order, and what comes of them.

    python -m tests.calibration.hand_eye.unsorted_sets --sets 2000 --seed 1

prints the counts. The poses are made and turned by SciPy's Rotation alone. A set is determined where it has 8 or more
pairs and the angles of the motions to any two rows differ by three standard deviations of their noise.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform as Rigid
from scipy.spatial.transform import Rotation

from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.hand_eye.pairs.files import PosePairs
from weldcal.calibration.hand_eye.pairs.importing import StatedForms, import_pairs
from weldcal.calibration.hand_eye.solve import HandEyeConfig
from weldcal.calibration.recorded_hand_eye import solve_pairs
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

KINDS = ("shuffled", "reversed", "missing", "missing, shuffled", "extra", "home at both ends", "both incomplete")


@dataclass(frozen=True)
class UnsortedSet:
    """Robot and camera poses (n, 4, 4) and (m, 4, 4), the true pairs of rows, and whether the data determine them."""

    kind: str
    mounting: str
    robot: Array
    camera: Array
    pairs: frozenset[tuple[int, int]]
    determined: bool


def unsorted_set(rng: np.random.Generator) -> UnsortedSet:
    """Draw a set of one of KINDS: 7 to 20 poses, noise of 0 to 2 degrees and 0 to 4 mm a pose."""
    kind = str(rng.choice(KINDS))
    mounting = str(rng.choice(["eye_in_hand", "eye_on_base"]))
    n, noise_deg, noise_m = int(rng.integers(7, 21)), rng.uniform(0.0, 2.0), rng.uniform(0.0, 0.004)
    tilt = np.radians(rng.uniform(15.0, 45.0))
    F = Rigid.from_components(
        np.array([0.5, 0.0, 0.4]) + rng.uniform(-0.2, 0.2, (n, 3)),
        Rotation.from_rotvec(tilt * rng.normal(size=(n, 3)) / 1.5) * Rotation.from_euler("x", 180, degrees=True),
    )
    X = Rigid.from_components(rng.uniform(-0.15, 0.15, 3), Rotation.random(rng=rng))
    Y = Rigid.from_components(rng.uniform(-0.8, 0.8, 3), Rotation.random(rng=rng))
    # eye in hand: base to target = F X G; eye on base: flange to target = F^-1 X G
    ours = F if mounting == "eye_in_hand" else F.inv()
    noise = Rigid.from_components(
        rng.normal(size=(n, 3)) * noise_m, Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(n, 3)))
    )
    G = X.inv() * ours.inv() * Y * noise
    robot, camera = list(range(n)), list(range(n))
    if kind == "reversed":
        camera.reverse()
    elif "shuffled" in kind:
        rng.shuffle(camera)
    some = sorted(rng.choice(n, int(rng.integers(1, 4)), replace=False).tolist())
    if "missing" in kind and n - len(some) >= 7:
        side = [robot, camera][int(rng.integers(2))]
        for k in some:
            side.remove(k)
    if kind == "both incomplete":
        robot.remove(some[0])
        camera.remove(next(k for k in range(n - 1, -1, -1) if k != some[0]))
    A, B = F.as_matrix()[robot], G.as_matrix()[camera]
    shift = (0, 0)
    if kind == "home at both ends":
        home = Rigid.from_components([0.3, -0.2, 0.6], Rotation.from_euler("xz", [180, 40], degrees=True)).as_matrix()
        A, shift = np.concatenate([home[None], A, home[None]]), (1, 0)
    if kind == "extra":
        other = Rigid.from_components(rng.uniform(-0.3, 0.3, (len(some), 3)), Rotation.random(len(some), rng=rng))
        at = sorted(rng.integers(0, len(B) + 1, len(some)).tolist())
        B = np.insert(B, at, other.as_matrix(), axis=0)
        camera = np.insert(np.array(camera), at, -1).tolist()
    pairs = frozenset((i + shift[0], camera.index(k) + shift[1]) for i, k in enumerate(robot) if k in camera)
    return UnsortedSet(kind, mounting, A, B, pairs, len(pairs) >= 8 and _apart(ours, np.radians(noise_deg)))


def _apart(F: Rigid, noise_rad: float) -> bool:
    """Whether the angles of the motions from any two rows to the others differ by three sigmas, rms."""
    n = len(F)
    R = F.rotation
    angle = np.array([[(R[i].inv() * R[j]).magnitude() for j in range(n)] for i in range(n)])
    for i in range(n):
        for j in range(i):
            others = [k for k in range(n) if k not in (i, j)]
            if np.sqrt(((angle[i, others] - angle[j, others]) ** 2).mean()) < 3.0 * np.sqrt(2.0) * noise_rad:
                return False
    return True


def judged(one: UnsortedSet) -> tuple[str, str]:
    """Return what came of a set by the true pairs, as `hand-eye` solves it: right, fewer, WRONG or refused; and why.

    Pairs that the solver excludes as outliers are not accepted.
    """
    lists = [listing_of_array("robot", one.robot), listing_of_array("camera", one.camera)]
    try:
        found = import_pairs(lists, "the set", one.mounting, StatedForms(unit="m"))
        pairs = PosePairs(source="the set", robot=found.robot, camera=found.camera, mode=one.mounting)
        result = solve_pairs(pairs, HandEyeConfig(folds=0))
    except WeldcalError as why:
        return "refused", str(why)
    used = {(int(i), int(j)) for i, j, good in zip(*found.rows, result.inliers, strict=True) if good}
    if not used <= one.pairs:
        return "WRONG", f"{sorted(used - one.pairs)} {' '.join(found.notes)}"
    return "right" if used == one.pairs else "fewer", f"without {sorted(one.pairs - used)} {' '.join(found.notes)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--refusals", action="store_true", help="print the refusals of determined sets, and what is wrong"
    )
    given = parser.parse_args()
    counts: Counter[tuple[str, bool, str]] = Counter()
    for k in range(given.sets):
        one = unsorted_set(np.random.default_rng([given.seed, k]))
        verdict, why = judged(one)
        counts[one.kind, one.determined, verdict] += 1
        if given.refusals and (verdict in ("WRONG", "fewer") or (verdict == "refused" and one.determined)):
            print(k, one.kind, one.mounting, len(one.robot), len(one.camera), one.determined, verdict, why)
    for determined in (True, False):
        for kind in (*KINDS, ""):
            row = Counter[str]()
            for (of, sure, verdict), count in counts.items():
                row[verdict] += count if sure == determined and kind in ("", of) else 0
            words = ", ".join(f"{row[w]} {w}" for w in ("right", "fewer", "refused", "WRONG"))
            print(f"{'determined' if determined else 'not determined':15s}{kind or 'all':20s}{words}", flush=True)


if __name__ == "__main__":
    main()
