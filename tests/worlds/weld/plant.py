"""Plant of the weld study: a lagging robot, a late and noisy tag, a tip in its groove."""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from tests.worlds.weld.budgets import Budget, WeldUnknowns, draw_world, planned_seam, roughness
from tests.worlds.weld.groove import DROP_M, SEAT_M, Groove, TipPlace
from tests.worlds.weld.seams import TrueSeam
from tests.worlds.weld.touch_place import with_touch_place
from weldcal.models.tools.elastomers import Elastomer
from weldcal.welding.numerics import Array, norm
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import DeflectionSample, Phase, ServoSample, WeldingCommand, WeldingState
from weldcal.welding.servo.step import welding_step
from weldcal.welding.servo.touch import touch_start_pose

FRAME_PERIOD_S = 1.0 / 30.0
COLUMNS = (
    "time_s", "phase", "torch_on", "torch_x", "torch_y", "torch_z", "robot_x", "robot_y", "robot_z", "tip_x", "tip_y",
    "tip_z", "v_x", "v_y", "v_z", "omega_rad_s", "n_d_dot_n_t", "delta_n_m", "delta_axial_m", "e_t_m", "s_torch_m",
    "s_tip_m", "tip_speed_m_s", "ahead_x", "ahead_y", "ahead_z", "left_x", "left_y", "left_z",
)  # fmt: skip
PHASES = tuple(Phase)
_KEPT = 64  # poses: half a second


class Stamps:
    """Stamps poses and pictures as a world does; the servo's clock is the stamp of the newest pose."""

    def __init__(self, world: WeldUnknowns, seed: int) -> None:
        self._world = world
        self._exact = not any((world.image_bias_s, world.image_jitter_s, world.pose_bias_s, world.pose_jitter_s))
        self._rng = np.random.default_rng((seed, 2))
        self._poses: deque[tuple[float, Array, Array]] = deque(maxlen=_KEPT)

    def pose(self, time: float, R: Array, p: Array) -> float:
        """Remember the pose of T (rotation (3,3), position (3,) m) at a true time s; return its stamp.

        A stamp is never earlier than the one before: a controller's clock runs on.
        """
        if self._exact:
            return time
        stamp = time + self._world.pose_bias_s + self._world.pose_jitter_s * float(self._rng.normal())
        if self._poses:
            stamp = max(stamp, self._poses[-1][0] + 1e-4)
        self._poses.append((stamp, R, p))
        return stamp

    def picture(self, taken: DeflectionSample) -> DeflectionSample:
        """Return the picture with its stamp, and with the pose that the poses' stamps give for that time.

        `pose` comes first.
        """
        if self._exact:
            return taken
        stamp = taken.capture_time + self._world.image_bias_s + self._world.image_jitter_s * float(self._rng.normal())
        return DeflectionSample(stamp, self._at(stamp), taken.deflection_T, taken.valid)

    def _at(self, stamp: float) -> RigidTransform:
        times = [t for t, _, _ in self._poses]
        if len(times) == 1:
            return RigidTransform(RotationMatrix(self._poses[0][1]), self._poses[0][2])
        k = min(max(bisect_right(times, stamp), 1), len(times) - 1)
        (t0, R0, p0), (t1, R1, p1) = self._poses[k - 1], self._poses[k]
        share = min(max((stamp - t0) / (t1 - t0), 0.0), 1.0)
        R = RotationMatrix.ProjectToRotationMatrix((1.0 - share) * R0 + share * R1)
        return RigidTransform(R, (1.0 - share) * p0 + share * p1)


class TipMemory:
    """What the tip's springs remember of its deflection in T; it begins as it was left `free_s` after a long weld."""

    def __init__(self, material: Elastomer, free_s: float = math.inf) -> None:
        self._material, self._x, self._state = material, np.zeros(3), np.zeros((2, 3))
        if math.isfinite(free_s):
            self._x, self._state = PRESSED_M, np.array([PRESSED_M, np.sign(PRESSED_M)])
            for _ in range(round(free_s / FREE_STEP_S)):
                self.step(self.rest(), FREE_STEP_S)

    def rest(self) -> Array:
        """Where the springs pull to (3,) m: beside the rest point, in T."""
        return self._material.rest(self._state, self._x)

    def step(self, deflection_T: Array, dt: float) -> None:
        """Go on by dt s to a deflection (3,) m."""
        self._state = self._material.step(self._state, self._x, deflection_T, dt)
        self._x = deflection_T


PRESSED_M = np.array([0.0, -2e-3, 3e-3])  # of a weld: against the left wall, and up
FREE_STEP_S = 0.01
Carrier = Callable[[Array, float], tuple[Array, Array, str | None]]
"""Moves a tool by a velocity (6,) for a time s: its rotation (3, 3), its position (3,) m, and why it has stopped for
good."""


@dataclass(frozen=True, eq=False)
class StudyRun:
    """One simulated weld.

    Attributes:
        table: (N, len(COLUMNS)) one row per servo tick, SI units; phase is its number in PHASES.
        torch_line: where the torch should run; planned: the plan raised to the tip's line.
        commands: what the servo answered at every tick.
        state: the servo's last; reason: why it stopped early, None when it did not.
    """

    table: Array
    torch_line: SeamCurve
    planned: SeamCurve
    commands: tuple[WeldingCommand, ...]
    state: WeldingState
    reason: str | None

    def column(self, name: str) -> Array:
        """One column (N,) by name."""
        return np.asarray(self.table[:, COLUMNS.index(name)])

    def points(self, name: str) -> Array:
        """Select points (N,3) m of "torch", "robot" or "tip", the velocity "v", or an axis of the tool.

        The axes are "ahead" (x_T) and "left" (y_T).
        """
        first = COLUMNS.index(f"{name}_x")
        return np.asarray(self.table[:, first : first + 3])

    def angles(self, rows: NDArray[np.bool_] | NDArray[np.int64], up: Array) -> tuple[Array, Array]:
        """Work and travel angle (n,) rad of the tool at these ticks, against surface normals (n,3)."""
        left, ahead = (
            np.arcsin(np.clip(np.sum(self.points(name)[rows] * up, axis=1), -1.0, 1.0)) for name in ("left", "ahead")
        )
        return left, ahead

    @property
    def phase(self) -> Phase:
        """The phase that the weld ended in."""
        return self.state.phase


def groove_config(config: ServoConfig) -> ServoConfig:
    """Return the settings with the drawn groove in them: seat and drop that a new tip would have there."""
    return replace(config, tool=replace(config.tool, tip_seat_height_m=SEAT_M, tip_drop_m=DROP_M))


def simulate(
    seam: TrueSeam,
    budget: Budget,
    config: ServoConfig,
    seed: int,
    gaps: tuple[tuple[float, float], ...] = (),
    time_limit_s: float = 150.0,
    plan: SeamCurve | None = None,
    hidden_s: tuple[float, float] = (math.inf, math.inf),
    carrier: Carrier | None = None,
    tacks: tuple[tuple[float, float, float], ...] = (),
    memory: TipMemory | None = None,
) -> StudyRun:
    """One weld of a seam in a budget; everything random follows from the seed. The servo is the cell's own, unchanged.

    The servo's settings come from the drawn groove; what the world really is (`budget.unknown`) reaches it through its
    samples only. The torch is judged against the line at its wanted height above the true root.

    Args:
        gaps: (from, to) m of the groove that are missing; plan: in place of the budget's; hidden_s: from when to when
            the tag is not seen; tacks: from, to and lift of the ball, m;
            memory: of the tip's springs;
            carrier: what moves the tool from where it is; None: a robot that follows every
            velocity.

    Source: the kinematic model of the design note, section B.3, with a V-groove for the side wall.
    """
    rng = np.random.default_rng(seed)
    root = SeamCurve.from_points(seam.points, seam.up)
    plan = planned_seam(seam, budget, rng) if plan is None else plan
    settings = with_touch_place(plan, groove_config(config))
    world = draw_world(budget.unknown, seed)
    wedge = world.wedge
    line = wedge.seat_line(root)
    line = line.raised(world.seat_m) if world.seat_m else line
    groove = Groove(line, gaps, roughness(root.length, budget, rng), budget.friction, wedge, tacks)
    wanted = root.raised(SEAT_M)
    torch_line = wanted.raised(settings.clearance_m) if settings.clearance_m else wanted
    reason: str | None = None
    dt, p_TW = settings.period_s, settings.p_TW
    X_BT = touch_start_pose(plan, settings)
    R, p = np.array(X_BT.rotation().matrix()), np.array(X_BT.translation())
    tip, state, V = TipPlace(p, groove), WeldingState(), np.zeros(6)
    yaw = RotationMatrix.MakeZRotation(budget.tag_yaw_rad).matrix() * budget.tag_gain
    bias = np.array((0.0, 0.0, budget.tag_bias_m))
    queue: list[DeflectionSample] = []
    newest: DeflectionSample | None = None
    lag = world.lag_s(budget.lag_s, settings.lag_s)
    blend = 1.0 if lag <= 0.0 else 1.0 - math.exp(-dt / lag)
    stamps = Stamps(world, seed)
    next_frame, stopped, rows = 0.0, 0, []
    commands: list[WeldingCommand] = []
    for k in range(int(time_limit_s / dt)):
        t = k * dt
        centre = tip.step(p if memory is None else p + R @ memory.rest(), dt)
        if memory is not None:
            memory.step(R.T @ (centre - p), dt)
        X_BT, now = RigidTransform(RotationMatrix(R), p), stamps.pose(t, R, p)
        if t >= next_frame - 1e-9:
            next_frame += FRAME_PERIOD_S
            deflection = yaw @ (R.T @ (centre - p)) + rng.normal(0.0, 1.0, 3) * budget.tag_sigma_m + bias
            queue.append(DeflectionSample(t, X_BT, deflection, not hidden_s[0] <= t < hidden_s[1]))
        while queue and queue[0].capture_time + budget.latency_s <= t + 1e-9:
            newest = stamps.picture(queue.pop(0))
        state, command = welding_step(state, ServoSample(now, X_BT, newest), plan, settings)
        commands.append(command)
        d = command.diagnostics
        rows.append(
            (t, PHASES.index(command.phase), float(command.torch_on), *(p + R @ p_TW).tolist(), *p.tolist(),
             *centre.tolist(), *command.V_BT[3:].tolist(), d.omega, d.n_d_dot_n_t, d.delta_n, d.delta_axial, d.e_t,
             d.s_torch, d.s_tip, d.tip_speed, *R[:, 0].tolist(), *R[:, 1].tolist())
        )  # fmt: skip
        stopped = stopped + 1 if command.phase in (Phase.DONE, Phase.FAULT) else 0
        if stopped > 30:
            break
        if k % 50 == 0 and state.phase == Phase.TRACK and _lost(torch_line, p + R @ p_TW, state.s_torch):
            reason = "The torch was lost: more than 60 mm off the seam."
            break
        V = V + blend * (command.V_BT - V)
        if carrier is None:
            R, p = _turned(R, V[:3] * dt, k), p + V[3:] * dt
            continue
        R, p, reason = carrier(V, dt)
        if reason is not None:
            break
    return StudyRun(np.array(rows), torch_line, plan.raised(SEAT_M), tuple(commands), state, reason or state.reason)


def _lost(line: SeamCurve, p: Array, s_near: float) -> bool:
    """Return whether p (3,) m is more than 60 mm off a line, its straight extensions included.

    At s_near m it is probably not.
    """
    if norm(p - line.frame(s_near).position) <= 0.060:
        return False
    return float(np.linalg.norm(p - line.position(line.project(p)))) > 0.060


def _turned(R: Array, turn: Array, tick: int) -> Array:
    """Return the rotation matrix after a small turn vector (3,) rad, made orthonormal every 50 ticks."""
    x, y, z = turn.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return R
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R = R + (math.sin(angle) / angle) * (K @ R) + ((1.0 - math.cos(angle)) / angle**2) * (K @ (K @ R))
    return np.array(RotationMatrix.ProjectToRotationMatrix(R).matrix()) if tick % 50 == 0 else R
