"""Plans flange poses for eye-on-base calibration: reachable, clear, visible and D-optimal."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.adjustment import most_informative
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.calibration.planning.clearance import (
    LinkCapsule,
    Surroundings,
    arm_bodies,
    lowest_point,
    occludes,
    self_distance,
)
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution, why_unreached
from weldcal.models.arms.kinematics import Chain, jacobian, link_frames, sigma_min
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset

_STARTS = 150  # views tried for a start posture: a choice, about 1 s


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Limits and weights of the planner; m and rad.

    ``theta_max_rad``: largest angle between face normal and line of sight (paper, section 2.1.4). ``table_z_m``: height
    of the table in B; ``margin_m`` above it. ``image_margin``: share of the image kept free at each side, and of the
    working range at each end, for an uncertain X_BC. ``sight_margin_m``: how far the scanner may stand from its guess
    without the arm coming into its sight. ``feature_radius_m``: outer radius of the flange or ring. ``max_travel_rad``:
    farthest any joint may go from the start. ``surroundings``: what else the arm must not touch. The sigmas weigh
    positions and normals in the information.
    """

    seed: int = 0
    theta_max_rad: float = float(np.radians(30.0))
    table_z_m: float = 0.0
    margin_m: float = 0.03
    image_margin: float = 0.08
    feature_radius_m: float = 0.0315
    scanner_clearance_m: float = 0.12
    self_clearance_m: float = 0.01
    sight_margin_m: float = 0.03
    max_travel_rad: float = 2.2
    min_sigma: float = 0.05
    min_spacing_m: float = 0.03
    sigma_position_m: float = 1e-4
    sigma_normal_rad: float = 1e-3
    candidates: int = 80
    max_trials: int = 3000
    work_point_B: tuple[float, float, float] | None = None
    surroundings: Surroundings = field(default_factory=Surroundings)


@dataclass(frozen=True, eq=False)
class PlannedPose:
    """One pose to visit: flange X_BF, joints q (n,) rad, feature X_BR.

    ``gain`` in log determinant of the information of X_BC, and ``sigma_m``, the predicted standard deviation (3-D) of a
    scanned point at the work point once this pose is in.
    """

    X_BF: RigidTransform
    q: Array
    X_BR: RigidTransform
    gain: float
    sigma_m: float


@dataclass(frozen=True)
class NextBest:
    """A pose to add: joints (6,) rad, X_BF of the (first) arm, and ``what`` it reduces, m, without and with it."""

    q: Array
    X_BF: RigidTransform
    before_m: float
    after_m: float
    q_2: Array | None = None
    what: str = "sigma of a scanned point"

    def sentence(self) -> str:
        """Return the proposal as one sentence for the operator."""
        joints, second = (
            ", ".join(f"{v:.0f}" for v in np.degrees(q)) for q in (self.q, () if self.q_2 is None else self.q_2)
        )
        p = 1e3 * self.X_BF.translation()
        return (
            f"joints [{joints}] deg{f', second arm [{second}] deg' if second else ''} (flange at {p[0]:.0f},"
            f" {p[1]:.0f}, {p[2]:.0f} mm in the base): it would reduce the {self.what} from"
            f" {1e3 * self.before_m:.4f} to {1e3 * self.after_m:.4f} mm."
        )


def plan_calibration_poses(
    arm: Chain,
    X_FR: RigidTransform,
    X_BC_guess: RigidTransform,
    scanner: ScannerPreset,
    n: int = 12,
    *,
    q_start: Array,
    config: PlannerConfig | None = None,
    tool: Sequence[Capsule] = (),
) -> list[PlannedPose]:
    """Plan ``n`` (>= 4) flange poses, most informative first.

    Greedy D-optimal on the information of X_BC about the work point.

    A constant bias of the feature in the flange counts as unknown too, so tilts and turns of the flange are valued.
    ``tool`` are capsules in the frame F that must clear the table and must not hide the feature. Deterministic for
    ``config.seed``. Raises UnreachableScanner, one sentence naming the commonest obstacle, when fewer than ``n`` poses
    exist or they do not span space, and InputError for n < 4.
    """
    if n < 4:
        raise InputError("A calibration needs at least 4 poses: ask for 4 or more.")
    config = config or PlannerConfig()
    pool, why = _candidates(arm, X_FR, X_BC_guess, scanner, q_start, config, tool)
    chosen = _greedy(pool, n, X_BC_guess, config)
    if len(chosen) < n:
        raise UnreachableScanner(_explain(why, len(chosen), n))
    p = np.array([c.X_BR.translation() for c in chosen])
    if float(np.linalg.svd(p - p.mean(axis=0), compute_uv=False)[2]) / np.sqrt(n) < 0.004:
        raise UnreachableScanner(
            "The poses that the arm can take before the scanner lie in one plane; move the scanner closer to the arm."
        )
    return chosen


def predicted_sigma(
    feature_poses: Sequence[RigidTransform], X_BC: RigidTransform, config: PlannerConfig | None = None
) -> float:
    """Predicted standard deviation (3-D, m) at the work point after scanning feature poses X_BR; inf if open."""
    config = config or PlannerConfig()
    work = _work_point(config, X_BC, list(feature_poses))
    total = sum((_information(X, X_BC, work, config) for X in feature_poses), np.zeros((9, 9)))
    return _sigma_at_work(total)


def _candidates(
    arm: Chain,
    X_FR: RigidTransform,
    X_BC: RigidTransform,
    scanner: ScannerPreset,
    q_start: Array | None,
    config: PlannerConfig,
    tool: Sequence[Capsule],
) -> tuple[list[PlannedPose], Counter[str]]:
    """Return what can be scanned near ``q_start``, or with any joint angles, and how often what forbids a view."""
    rng = np.random.default_rng(config.seed)
    bodies = arm_bodies(arm, tool)
    X_RF = X_FR.inverse()
    pool: list[PlannedPose] = []
    why: Counter[str] = Counter()
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    ring_R = np.vstack(
        [config.feature_radius_m * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles]), np.zeros((1, 3))]
    )
    for _ in range(config.max_trials):
        if len(pool) >= config.candidates:
            break
        X_CR = random_view(rng, scanner, config.feature_radius_m, config.image_margin, config.theta_max_rad)
        if X_CR is None:
            why["the flange does not fit into the scanner's field of view"] += 1
            continue
        X_BR = X_BC @ X_CR
        X_BF = X_BR @ X_RF
        found, reason = [], "the scanner's working range is out of the arm's reach"
        if float(arm.up @ X_BR.translation()) < config.table_z_m + config.margin_m:
            reason = "the table is in the way"
        elif q_start is None:
            found = [*inverse_kinematics(arm, X_BF)]
            reason = "" if found else why_unreached(arm, X_BF)
        elif (q := nearest_solution(arm, X_BF, q_start)) is not None:
            found = [q]
        if not found:
            why[reason] += 1
        for q in found:
            start = q if q_start is None else q_start
            if reason := why_not(arm, q, X_BC, (X_BR @ ring_R.T).T, bodies, start, config):
                why[reason] += 1
            else:
                pool.append(PlannedPose(X_BF, q, X_BR, 0.0, float("inf")))
    return pool, why


def start_posture(
    arm: Chain,
    X_FR: RigidTransform,
    X_BC: RigidTransform,
    scanner: ScannerPreset,
    config: PlannerConfig,
    tool: Sequence[Capsule] = (),
) -> Array:
    """Choose clear joint angles (n,) rad that hold the feature to the scanner, from which most such others are near.

    Raises:
        UnreachableScanner: no such joint angles; the message names the commonest obstacle.
    """
    pool, why = _candidates(arm, X_FR, X_BC, scanner, None, replace(config, max_trials=_STARTS), tool)
    if not pool:
        raise UnreachableScanner(_explain(why, 0, 1))
    q = np.array([c.q for c in pool])
    near = np.abs(q[:, None] - q).max(axis=2) <= config.max_travel_rad
    return np.asarray(q[int(np.argmax(near.sum(axis=1)))])


def random_view(
    rng: np.random.Generator, scanner: ScannerPreset, radius_m: float, image_margin: float, theta_max_rad: float
) -> RigidTransform | None:
    """Draw a pose X_CR of a circle that lies whole in the scanner's image and working range, less a margin of both.

    The normal lies within ``theta_max_rad`` of the line of sight, uniform over that cap. None where the circle does not
    fit into the image at the distance drawn.
    """
    span = image_margin * (scanner.far_m - scanner.near_m)
    z = rng.uniform(scanner.near_m + span, scanner.far_m - span)
    place = []
    for f, c, size in ((scanner.fx, scanner.cx, scanner.width), (scanner.fy, scanner.cy, scanner.height)):
        free = image_margin * size
        low, high = (free - c) / f * z + radius_m, (size - 1 - free - c) / f * z - radius_m
        if low >= high:
            return None
        place.append(rng.uniform(low, high))
    p = np.array([*place, z])
    sight = -p / np.linalg.norm(p)
    tilt = float(np.arccos(rng.uniform(np.cos(theta_max_rad), 1.0)))
    side = np.cross(sight, [1.0, 0.0, 0.0])
    side = exp_rotation(rng.uniform(0.0, 2.0 * np.pi) * sight) @ (side / np.linalg.norm(side))
    normal = exp_rotation(tilt * side) @ sight
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    R = RotationMatrix(np.column_stack([x, np.cross(normal, x), normal]))
    return RigidTransform(R @ RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi)), p)


def why_not(
    arm: Chain,
    q: Array,
    X_BC: RigidTransform,
    points_B: Array,
    bodies: list[LinkCapsule],
    q_start: Array,
    config: PlannerConfig,
    what: str = "flange",
) -> str:
    """Return why the scanner cannot scan points (N, 3) m of ``what`` in this posture, or an empty text."""
    if float(np.abs(q - q_start).max()) > config.max_travel_rad:
        return "the joints would have to travel too far from the start posture"
    if sigma_min(jacobian(arm, q)) < config.min_sigma:
        return "the arm would stand in a singularity"
    frames = link_frames(arm, q)
    if lowest_point(bodies, frames, arm.up) < config.table_z_m + config.margin_m:
        return "the table is in the way"
    if self_distance(bodies, frames) < config.self_clearance_m:
        return "the arm would touch itself"
    if touched := config.surroundings.touched(bodies, frames):
        return f"{touched} is in the way"
    eye = np.asarray(X_BC.translation())
    hidden, near_eye = occludes(bodies, frames, eye, points_B, config.sight_margin_m)
    if near_eye < config.scanner_clearance_m:
        return "the arm would come too close to the scanner"
    if hidden:
        return f"the arm hides the {what} from the scanner"
    between = config.surroundings.blocks(eye, points_B)
    return f"{between} hides the {what} from the scanner" if between else ""


def _information(X_BR: RigidTransform, X_BC: RigidTransform, work: Array, config: PlannerConfig) -> Array:
    """Information (9, 9) of one observation on [rotation about the work point; translation; centre bias in R]."""
    lever = X_BR.translation() - work
    R = X_BR.rotation().matrix()
    J_p = np.hstack([-skew(lever), np.eye(3), -R])
    J_n = np.hstack([-skew(R[:, 2]), np.zeros((3, 6))])
    return np.asarray(J_p.T @ J_p / config.sigma_position_m**2 + J_n.T @ J_n / config.sigma_normal_rad**2)


def _work_point(config: PlannerConfig, X_BC: RigidTransform, poses: list[RigidTransform]) -> Array:
    if config.work_point_B is not None:
        return np.array(config.work_point_B)
    return np.mean([X.translation() for X in poses], axis=0) if poses else np.asarray(X_BC.translation())


def _sigma_at_work(information: Array) -> float:
    values = np.linalg.eigvalsh(information)
    if values[0] < 1e-9 * values[-1]:
        return float("inf")
    return float(np.sqrt(np.trace(np.linalg.inv(information)[3:6, 3:6])))


def _greedy(pool: list[PlannedPose], n: int, X_BC: RigidTransform, config: PlannerConfig) -> list[PlannedPose]:
    """Choose the ``n`` poses that in turn add most to the log determinant of the information.

    They keep apart from each other.
    """
    if not pool:
        return []
    work = _work_point(config, X_BC, [c.X_BR for c in pool])
    # what is believed before the first scan: weak, so that four poses already span space; the bias is known to about 1
    # mm
    total = np.diag([1.0 / 0.1**2] * 3 + [1.0 / 0.1**2] * 3 + [1.0 / 0.001**2] * 3)
    gains = np.array([_information(c.X_BR, X_BC, work, config) for c in pool])
    places = np.array([c.X_BR.translation() for c in pool])

    def apart(chosen: list[int]) -> Array:
        return np.asarray(
            (np.linalg.norm(places[:, None] - places[chosen], axis=2) >= config.min_spacing_m).all(axis=1)
        )

    order, values = most_informative(total, gains, n, _value, apart)
    before = [float(_value(total)), *values]
    sums = total + np.cumsum(gains[order], axis=0)
    return [
        PlannedPose(c.X_BF, c.q, c.X_BR, values[k] - before[k], _sigma_at_work(sums[k]))
        for k, c in enumerate(pool[i] for i in order)
    ]


def _value(information: Array) -> Array:
    """Log determinants (...) of informations (..., 9, 9) of X_BC with the bias marginalised out."""
    A, B, D = information[..., :6, :6], information[..., :6, 6:], information[..., 6:, 6:]
    return np.asarray(np.linalg.slogdet(A - B @ np.linalg.solve(D, np.swapaxes(B, -1, -2)))[1])


def _explain(why: Counter[str], found: int, wanted: int) -> str:
    reason = why.most_common(1)[0][0] if why else "the poses found lie too close together"
    amount = "No pose" if found == 0 else f"Only {found} of {wanted} poses"
    cure = "move the scanner or correct its guessed pose"
    return f"{amount} of the flange can be scanned, most often because {reason}; {cure}."
