"""Guard the arm near singular positions: its system, and the check before a motion that the path passes it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context

from weldcal.models.arms.compiled_kinematics import tick_jacobian
from weldcal.models.arms.inverse import continued_solution
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError
from weldcal.systems.leaf_system import LeafSystem
from weldcal.welding.servo.guards import GUARD, SPEED_SHARE, ArmGuardConfig, guarded_joint_velocity

LEAST_SHARE = 0.9  # of its commanded speed, which a motion keeps everywhere
LIMIT_MARGIN_RAD = 0.02  # of a joint's angle: the true path differs from the planned one
EVERY_M, EVERY_RAD = 0.004, 0.06  # between the places that are checked
_BESIDE_RAD = 0.2  # farther than this from where its speeds lead a joint has changed to another branch


class SingularityGuard(LeafSystem):
    """Maps the tip's spatial velocity to joint velocities within the limits; stops before a singularity.

    .. pydrake_system::

        name: SingularityGuard
        input_ports:
        - V_BT
        - position_measured
        output_ports:
        - guarded
        - velocity
        - margin

    `V_BT` (6) [omega rad/s; v m/s] in B. `guarded` (8) is both of the following. `velocity` (6) rad/s. `margin` (2):
    least singular value of the length-scaled Jacobian, and 1.0 while the arm is stopped. The seam's own singularity
    (n_d . n_t -> 0) is guarded inside the servo.
    """

    def __init__(
        self,
        arm: ArmModel,
        X_FT: RigidTransform,
        config: ArmGuardConfig | None = None,
        speed_share: float = SPEED_SHARE,
    ) -> None:
        super().__init__()
        self._arm, self._p_FT = arm, np.array(X_FT.translation())
        self._config, self._limit = config or GUARD, speed_share * arm.velocity_limit
        # the first call loads machine code, which no tick has time for
        guarded_joint_velocity(np.eye(6), np.zeros(6), self._limit, self._config)
        self._V = self.DeclareVectorInputPort("V_BT", 6)
        self._q = self.DeclareVectorInputPort("position_measured", 6)
        ticket = {self._V.ticket(), self._q.ticket()}
        self._both = self.DeclareVectorOutputPort("guarded", 8, self._calculate, ticket)
        self.DeclareVectorOutputPort("velocity", 6, self._velocity, ticket)
        self.DeclareVectorOutputPort("margin", 2, self._margin, ticket)

    def _calculate(self, context: Context, output: BasicVector) -> None:
        J = tick_jacobian(self._arm, self._q.Eval(context), self._p_FT)
        guarded = guarded_joint_velocity(J, self._V.Eval(context), self._limit, self._config)
        output.SetFromVector(np.concatenate([guarded.q_dot, [guarded.sigma_min, float(guarded.stopped)]]))

    def _velocity(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both.Eval(context)[:6])

    def _margin(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._both.Eval(context)[6:])


class InfeasiblePath(WeldcalError):
    """The arm cannot follow a planned motion: the sentence names the place and the joint, and what to change."""

    def __init__(self, problem: str, advice: str = "move the workpiece") -> None:
        super().__init__(f"{problem}: {advice}.")
        self.problem = problem

    def advised(self, advice: str) -> "InfeasiblePath":
        """Return the same with other advice."""
        return type(self)(self.problem, advice)


@dataclass(frozen=True, eq=False, kw_only=True)
class GuardedMotion:
    """A planned motion of a frame T on the flange, which the guard turns into joint velocities.

    Attributes:
        name: of the motion in a sentence, such as "the seam".
        X_BT: poses in order.
        time: (n,) s of the poses, at the commanded speed.
        X_FT: T in the flange frame.
        along: (n,) m, arc length of the poses in a sentence; empty: the sentence gives the distance from the start.
        least_share: of the commanded speed, which the guard must allow everywhere.
        every_pose: whether each pose is followed, not one every EVERY_M or EVERY_RAD.
        weave_rad_s: largest further rate of the tool about its z axis, to both sides.
    """

    name: str
    X_BT: Sequence[RigidTransform]
    time: Array
    X_FT: RigidTransform
    along: Array = field(default_factory=lambda: np.zeros(0))
    least_share: float = LEAST_SHARE
    every_pose: bool = False
    weave_rad_s: float = 0.0


class Followed(NamedTuple):
    """How the arm follows a motion.

    Joints (n, 6) rad, their places (n,) m, the least singular value and share of the speed.
    """

    q: Array
    along: Array
    sigma_min: float
    share: float


def straight(
    name: str, X_BT: RigidTransform, way: Array, speed_m_s: float, X_FT: RigidTransform, least_share: float = 0.25
) -> GuardedMotion:
    """Return a motion from X_BT along `way` (3,) m; a descent, which may be slowed more than a weld."""
    length = float(np.linalg.norm(way))
    share = np.linspace(0.0, 1.0, max(2, round(length / EVERY_M) + 1))
    poses = [RigidTransform(X_BT.rotation(), X_BT.translation() + u * way) for u in share]
    return GuardedMotion(name=name, X_BT=poses, time=share * length / speed_m_s, X_FT=X_FT, least_share=least_share)


def check_path(arm: ArmModel, q_start: Array, motions: Sequence[GuardedMotion]) -> list[Followed]:
    """Follow motions one after the other on the branch of q_start (6,) rad, as the guard would.

    At every place the pose is reached by Newton's steps from the place before, the joints are within their limits, no
    joint changes its branch, and the guard allows `least_share` of the commanded speed.

    Raises:
        InfeasiblePath: with the first place and the joint.
    """
    found, q = [], np.asarray(q_start, dtype=np.float64)
    for motion in motions:
        found.append(_follow(arm, q, motion))
        q = found[-1].q[-1]
    return found


def check_joints(arm: ArmModel, q: Array, where: str) -> None:
    """Check that joints (6,) rad are within the arm's limits.

    Raises:
        InfeasiblePath: with the joint.
    """
    over = np.maximum(q - arm.position_upper, arm.position_lower - q)
    k = int(np.argmax(over))
    if over[k] > -LIMIT_MARGIN_RAD:
        limits = np.degrees([arm.position_lower[k], arm.position_upper[k]])
        raise InfeasiblePath(
            f"The arm cannot follow {where}: the {joint_name(arm, k)} would be at {np.degrees(q[k]):.0f} deg, and its"
            f" limits are {limits[0]:.0f} to {limits[1]:.0f} deg"
        )


def joint_name(arm: ArmModel, k: int) -> str:
    """Return a joint's name in a sentence."""
    return arm.joint_names[k].removesuffix("_joint").replace("_", " ")


def _follow(arm: ArmModel, q: Array, motion: GuardedMotion) -> Followed:
    p = np.array([X.translation() for X in motion.X_BT])
    R = np.array([X.rotation().matrix() for X in motion.X_BT])
    s = motion.along if len(motion.along) else np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]
    X_TF, p_FT, limit = motion.X_FT.inverse(), np.array(motion.X_FT.translation()), SPEED_SHARE * arm.velocity_limit
    V = np.hstack([_rates(R, motion.time), np.gradient(p, motion.time, axis=0)])
    joints: list[Array] = []
    least_sigma, least_share, before = np.inf, 1.0, -1
    places = list(range(len(p))) if motion.every_pose else _places(p, R)
    for k in places:
        where = f"{motion.name} at {1e3 * s[k]:.0f} mm"
        J = tick_jacobian(arm, q, p_FT)
        found = continued_solution(arm, motion.X_BT[k] @ X_TF, q)
        if found is None:
            raise InfeasiblePath(
                f"The arm cannot follow {where}: it does not reach so far, with the {_stuck(arm, J)} at its end"
            )
        check_joints(arm, found, where)
        J = tick_jacobian(arm, found, p_FT)
        weave = np.r_[motion.weave_rad_s * R[k, :, 2], np.zeros(3)]
        for twist in (V[k] + weave, V[k] - weave, V[k]):  # the last one leads to the next place
            allowed = guarded_joint_velocity(J, twist, limit, GUARD)
            least_sigma, least_share = min(least_sigma, allowed.sigma_min), min(least_share, allowed.scale)
            if allowed.sigma_min < GUARD.sigma_slow and allowed.scale < motion.least_share:
                raise InfeasiblePath(
                    f"The arm cannot follow {where}: it comes too near to a singular position (least singular value "
                    f"{allowed.sigma_min:.3f}), in which the {_stuck(arm, J)} turns without effect"
                )
            if allowed.scale < motion.least_share:
                k_fast = int(np.argmax(np.abs(allowed.q_dot) / limit))
                raise InfeasiblePath(
                    f"The arm cannot follow {where} at its speed: the {joint_name(arm, k_fast)} would turn at "
                    f"{abs(allowed.q_dot[k_fast]) / allowed.scale:.2f} rad/s, and {limit[k_fast]:.2f} rad/s are allowed"
                )
        if before >= 0:
            led = q + allowed.q_dot / allowed.scale * (motion.time[k] - motion.time[before])
            k_off = int(np.argmax(np.abs(found - led)))
            if abs(found[k_off] - led[k_off]) > _BESIDE_RAD:
                raise InfeasiblePath(
                    f"The arm cannot follow {where}: the {joint_name(arm, k_off)} would have to change its branch"
                )
        joints.append(found)
        q, before = found, k
    return Followed(np.array(joints), s[places], least_sigma, least_share)


def _places(p: Array, R: Array) -> list[int]:
    """Return the poses to check: the first, the last, and every EVERY_M or EVERY_RAD between them."""
    turn = np.linalg.norm(np.diff(R, axis=0), axis=(1, 2)) / np.sqrt(2.0)
    way = np.linalg.norm(np.diff(p, axis=0), axis=1) / EVERY_M + turn / EVERY_RAD
    steps = np.floor(np.r_[0.0, np.cumsum(way)])
    return sorted({*np.flatnonzero(np.diff(steps, prepend=-1.0) > 0.0).tolist(), len(p) - 1})


def _rates(R: Array, time: Array) -> Array:
    """Angular velocity (n, 3) rad/s of rotations (n, 3, 3), in B."""
    W = np.gradient(R, time, axis=0) @ np.transpose(R, (0, 2, 1))
    return 0.5 * np.column_stack([W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]])


def _stuck(arm: ArmModel, J: Array) -> str:
    """Name of the joint that turns most where the tool nearly does not move."""
    return joint_name(arm, int(np.argmax(np.abs(np.linalg.svd(J * GUARD.row_scale.reshape(6, 1))[2][5]))))
