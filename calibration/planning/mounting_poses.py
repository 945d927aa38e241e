"""Plans poses for calibration in any mounting: reachable, visible, clear and D-optimal in the unknowns."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.adjustment import most_informative
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.hand_eye.problem import linearise
from weldcal.calibration.planning.calibration_poses import random_view
from weldcal.calibration.planning.mounting_scene import FLANGE, Bodies, MountingScene
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import jacobian, sigma_min
from weldcal.models.arrays import Array

_PRIOR = (0.2, 0.2)  # what is believed of an unknown pose before the first scan: rad and m, per axis
_BIAS_M = 1e-3  # and of a constant error of the circle's centre in its own frame


@dataclass(frozen=True, kw_only=True)
class MountingPlan:
    """Limits (m, rad) and how the poses are weighed.

    ``theta_max_rad``: between the circle's normal and the line of sight. ``image_margin``: share of the image, and of
    the working range, kept free at each side for an uncertain belief. ``spread_rad``: how far a joint may go from home
    where joints are drawn. ``max_travel_rad``: farthest any joint goes from home.
    """

    seed: int = 0
    theta_max_rad: float = float(np.radians(30.0))
    image_margin: float = 0.08
    spread_rad: float = float(np.radians(35.0))
    max_travel_rad: float = 2.2
    table_z_m: float = 0.0
    margin_m: float = 0.03
    gap_m: float = 0.015
    min_sigma: float = 0.05
    candidates: int = 60
    max_trials: int = 6000
    sigma_position_m: float = 1e-4
    sigma_normal_rad: float = 1e-3
    step_rad: float = 0.15


@dataclass(frozen=True, eq=False)
class MountingPose:
    """A pose to visit: joints (6,) rad of the first and, where there is one, the second arm; X_CR that is expected.

    ``via_home``: the straight way from the pose before it is not free, the one through home is.
    """

    q: Array
    q_2: Array | None
    X_CR: RigidTransform
    via_home: bool = False

    @property
    def joints(self) -> Array:
        """The joints of one arm (6,) or both (12,), rad."""
        return self.q if self.q_2 is None else np.concatenate([self.q, self.q_2])


def plan_mounting_poses(scene: MountingScene, n: int, held_out: int, plan: MountingPlan) -> tuple[MountingPose, ...]:
    """Plan ``n`` poses, most informative first, then ``held_out`` drawn at random, then all others that would do.

    The order is greedy and D-optimal in the unknowns. Each of the first n + held_out has a free way from home, the
    second arm going first, and is reached on it or from the pose before (the first held-out one from home).
    Deterministic for ``plan.seed``.

    Raises:
        UnreachableScanner: one sentence that names the commonest obstacle.
    """
    rng = np.random.default_rng(plan.seed)
    bodies = Bodies(scene)
    pool, why = _pool(scene, bodies, plan, rng)
    order = _greedy(scene, pool, plan)
    chosen = _chain(bodies, [pool[i] for i in order], n, plan)
    rest = [pool[i] for i in order if not any(pool[i].q is c.q for c in chosen)]
    aside = _chain(bodies, [rest[i] for i in rng.permutation(len(rest))], held_out, plan)
    if len(chosen) < n or len(aside) < held_out:
        reason = why.most_common(1)[0][0] if why else "the poses found lie too close together"
        raise UnreachableScanner(
            f"Only {len(chosen) + len(aside)} of {n + held_out} poses show the circle to the scanner, most often"
            f" because {reason}; mount the scanner elsewhere, correct its guessed pose, or choose another home_deg."
        )
    others = [p for p in rest if not any(p.q is a.q for a in aside)]
    return (*chosen, *aside, *others)


def information(scene: MountingScene, poses: Sequence[MountingPose], sigma_m: Array | float, sigma_rad: float) -> Array:
    """Information of observations of the circle at some poses (k, m + 3, m + 3).

    Of the free unknowns, in the order of the solver, and of a constant bias of the centre in its own frame.
    ``sigma_m``: of the centre, one for all or (3,) along the circle's own axes.
    """
    observations = [
        scene.observation(p.q, p.q_2, p.X_CR.translation(), p.X_CR.rotation().matrix()[:, 2]) for p in poses
    ]
    lin = linearise(scene.problem(observations), scene.state, np.zeros(3))
    Jd = np.concatenate([lin.Jd, np.broadcast_to(np.eye(3), (len(poses), 3, 3))], axis=2)
    Jd = Jd / np.broadcast_to(sigma_m, (3,))[:, None]
    Jw = np.concatenate([lin.Jw, np.zeros((len(poses), 3, 3))], axis=2) / sigma_rad
    return np.asarray(np.swapaxes(Jd, 1, 2) @ Jd + np.swapaxes(Jw, 1, 2) @ Jw)


def prior(scene: MountingScene) -> Array:
    """Prior information (m + 3, m + 3)."""
    unknowns = len(scene.mounting.unknowns) - len(scene.known)
    each = [1.0 / _PRIOR[0] ** 2] * 3 + [1.0 / _PRIOR[1] ** 2] * 3
    return np.diag(each * unknowns + [1.0 / _BIAS_M**2] * 3)


def work_point(scene: MountingScene) -> Array:
    """p_CWork (3,) m: on the scanner's axis at its best distance."""
    return np.array([0.0, 0.0, scene.scanner.optimum_m])


def _at(pose: MountingPose) -> tuple[Array, Array | None]:
    return pose.q, pose.q_2


def _way(
    bodies: Bodies, start: tuple[Array, Array | None], end: tuple[Array, Array | None], plan: MountingPlan
) -> bool:
    """Test whether one arm after the other, the second first, gets from start to end.

    The way back home has the opposite order.
    """
    between = (start[0], end[1])
    if bodies.scene.two and not bodies.clear(start, between, plan.table_z_m, plan.step_rad):
        return False
    return bodies.clear(between, end, plan.table_z_m, plan.step_rad)


def _chain(bodies: Bodies, poses: Sequence[MountingPose], n: int, plan: MountingPlan) -> list[MountingPose]:
    """Return the first n poses with a free path from home.

    The way home is the same backwards. Each pose is reached from the one before it where that is free too.
    """
    home = (bodies.scene.q_home, bodies.scene.q_home_2)
    kept: list[MountingPose] = []
    for pose in poses:
        if len(kept) == n:
            break
        if _way(bodies, home, _at(pose), plan):
            direct = not kept or _way(bodies, _at(kept[-1]), _at(pose), plan)
            kept.append(replace(pose, via_home=not direct))
    return kept


def _pool(
    scene: MountingScene, bodies: Bodies, plan: MountingPlan, rng: np.random.Generator
) -> tuple[list[MountingPose], Counter[str]]:
    pool: list[MountingPose] = []
    why: Counter[str] = Counter()
    draw = _by_joints if "arm" in scene.configuration else _by_view
    for _ in range(plan.max_trials):
        if len(pool) >= plan.candidates:
            break
        drawn = draw(scene, plan, rng)
        if isinstance(drawn, str):
            why[drawn] += 1
            continue
        q, q_2 = drawn
        reason = _refuse(scene, bodies, plan, q, q_2)
        if reason is None:
            pool.append(MountingPose(q, q_2, scene.seen(q, q_2)))
        else:
            why[reason] += 1
    return pool, why


def _by_view(scene: MountingScene, plan: MountingPlan, rng: np.random.Generator) -> tuple[Array, Array | None] | str:
    """Draw how the scanner sees the circle, and ask for the joints."""
    X_CR = random_view(rng, scene.scanner, scene.radius_m, plan.image_margin, plan.theta_max_rad)
    if X_CR is None:
        return "the circle does not fit into the scanner's field of view"
    q_2 = None
    if scene.q_home_2 is not None:
        q_2 = scene.q_home_2 + rng.uniform(-plan.spread_rad, plan.spread_rad, 6)
    X_LR = scene.X_LC @ X_CR
    on_base = scene.configuration == "eye_on_base"
    X_BF = X_LR @ scene.X_HR.inverse() if on_base else scene.circle([], q_2) @ X_LR.inverse()
    q = nearest_solution(scene.arm, X_BF, scene.q_home)
    if q is None:
        return "it is out of the arm's reach"
    return q, q_2


def _by_joints(scene: MountingScene, plan: MountingPlan, rng: np.random.Generator) -> tuple[Array, Array | None] | str:
    """Draw the joints between scanner and circle; the others stay at home."""
    q = scene.q_home.copy()
    if scene.configuration == "eye_on_arm_target_on_base":
        # the first joint turns scanner and all about the circle's own axis: it shows nothing new
        q[1 : scene.link] += rng.uniform(-plan.spread_rad, plan.spread_rad, scene.link - 1)
    else:
        q[scene.link : 5] += rng.uniform(-plan.spread_rad, plan.spread_rad, 5 - scene.link)
        q[5] += 2.5 * rng.uniform(
            -plan.spread_rad, plan.spread_rad
        )  # the flange's own axis: it costs nothing of the view
    if not ((q >= scene.arm.position_lower) & (q <= scene.arm.position_upper)).all():
        return "a joint is at its limit"
    return q, None


def _refuse(scene: MountingScene, bodies: Bodies, plan: MountingPlan, q: Array, q_2: Array | None) -> str | None:
    """Why this posture will not do, or None."""
    if float(np.abs(q - scene.q_home).max()) > plan.max_travel_rad:
        return "the joints would have to travel too far from home"
    frames = scene.frames(q)
    frames_2 = None if q_2 is None else scene.frames_2(q_2)
    X_BR = scene.circle(frames, q_2)
    X_CR = (frames[scene.link] @ scene.X_LC).InvertAndCompose(X_BR)
    if not _in_view(scene, plan, X_CR):
        return "the circle would be out of the scanner's sight"
    # an arm that looks at itself need not be free to move on in every direction
    if scene.link in (0, FLANGE) and sigma_min(jacobian(scene.arm, q)) < plan.min_sigma:
        return "the arm would stand in a singularity"
    if bodies.lowest(frames, frames_2) < plan.table_z_m + plan.margin_m:
        return "the table is in the way"
    if bodies.gap(frames, frames_2) < plan.gap_m:
        return "the arm or its scanner would touch something"
    return "an arm hides the circle from the scanner" if bodies.hidden(frames, frames_2, X_BR) else None


def _in_view(scene: MountingScene, plan: MountingPlan, X_CR: RigidTransform) -> bool:
    s, r = scene.scanner, scene.radius_m
    p, n = np.asarray(X_CR.translation()), X_CR.rotation().matrix()[:, 2]
    span = plan.image_margin * (s.far_m - s.near_m)
    if not s.near_m + span < p[2] < s.far_m - span:
        return False
    if float(-n @ p) / float(np.linalg.norm(p)) < np.cos(plan.theta_max_rad) - 1e-9:
        return False
    for k, (f, c, size) in enumerate(((s.fx, s.cx, s.width), (s.fy, s.cy, s.height))):
        free = plan.image_margin * size
        if not (free - c) / f * p[2] + r <= p[k] <= (size - 1 - free - c) / f * p[2] - r:
            return False
    return True


def _greedy(scene: MountingScene, pool: Sequence[MountingPose], plan: MountingPlan) -> list[int]:
    """Return all poses of the pool, each the one that adds most to those before it."""
    if not pool:
        return []
    gains = information(scene, pool, plan.sigma_position_m, plan.sigma_normal_rad)
    return most_informative(prior(scene), gains, len(pool), lambda total: np.linalg.slogdet(total)[1])[0]
