"""A small world to weld in: a tip on springs in a V-groove, a tag that is late and noisy, a robot that lags."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.welding.seam import SeamCurve
from weldcal.welding.servo import welding_step
from weldcal.welding.servo_state import DeflectionSample, Phase, ServoConfig, ServoSample, WeldingCommand, WeldingState
from weldcal.welding.touch import touch_start_pose
from weldcal.welding.vectors import Array

RADIUS = 2.5e-3
HALF_ANGLE = math.radians(22.5)
DEPTH = 8.0e-3
HALF_WIDTH = DEPTH * math.tan(HALF_ANGLE)
SEAT = RADIUS / math.sin(HALF_ANGLE)  # centre of the seated tip above the groove's root
DROP = DEPTH + RADIUS - SEAT  # how much lower it sits than on the face
_STIFF = np.array([600.0, 300.0])  # lateral, axial N/m
_STEP = 2e-3


@dataclass(frozen=True)
class Budget:
    """What is wrong with this world: tag, robot, plan."""

    tag_sigma_m: float = 0.05e-3
    gain: float = 1.03
    tag_yaw_rad: float = math.radians(0.5)
    lag_s: float = 0.020
    latency_s: float = 0.040
    friction: float = 0.2
    plan_shift_m: float = 2.0e-3
    plan_angle_rad: float = math.radians(0.5)
    plan_warp_m: float = 0.5e-3
    plan_height_m: float = 0.5e-3
    roughness_m: float = 0.0


PERFECT = Budget(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOMINAL = Budget()
HARD = Budget(0.10e-3, 1.08, math.radians(0.5), 0.050, 0.060, 0.35, 3.0e-3, math.radians(0.5), 1.0e-3, 1.0e-3, 0.1e-3)


@dataclass(frozen=True)
class Groove:
    """The true groove: its tip line, where it is missing, and where the work ends."""

    line: SeamCurve
    gaps: tuple[tuple[float, float], ...] = ()
    rough: Array = field(default_factory=lambda: np.zeros(2))

    def present(self, s: float) -> bool:
        return 0.0 <= s <= self.line.length and not any(a < s < b for a, b in self.gaps)

    def floor(self, y: float) -> tuple[float, float]:
        """Lowest centre height over the seat at a lateral place, and its slope."""
        x = abs(y)
        on_wall = HALF_WIDTH - RADIUS * math.cos(HALF_ANGLE)
        if x <= on_wall:
            return x / math.tan(HALF_ANGLE), math.copysign(1.0 / math.tan(HALF_ANGLE), y)
        if x >= HALF_WIDTH:
            return DROP, 0.0
        # The centre rolls round the sharp upper edge.
        rise = math.sqrt(RADIUS**2 - (HALF_WIDTH - x) ** 2)
        return DEPTH - SEAT + rise, math.copysign((HALF_WIDTH - x) / rise, y)


@dataclass
class Tip:
    """Place of the tip's centre along, across and above the groove's tip line, m."""

    s: float
    y: float
    z: float
    touching: bool = False


def step_tip(tip: Tip, rest: Array, groove: Groove, friction: float, dt: float) -> Array:
    """Move the tip for one tick towards balance of springs, walls and Coulomb friction; its centre (3,) m.

    Massless and damped (30 ms when free), as in the 2-D model of weld_law.md, B.3, with a whole V-groove about it.
    """
    rate = dt / _STEP
    for _ in range(max(1, round(rate))):
        f = groove.line.frame(tip.s)
        at = f.position + tip.y * f.normal + tip.z * f.up
        gap = rest - at
        gt, gn, gb = float(gap @ f.tangent), float(gap @ f.normal), float(gap @ f.up)
        share = 1.0 - math.exp(-_STEP / 0.030)
        if not groove.present(tip.s):
            tip.touching = False
            tip.s, tip.y, tip.z = tip.s + share * gt, tip.y + share * gn, tip.z + share * gb
            if groove.present(tip.s):
                tip.z = max(tip.z, groove.floor(tip.y)[0])
            continue
        low, slope = groove.floor(tip.y)
        if tip.z > low + 1e-9 and tip.z + share * gb > low:
            tip.touching = False
            tip.s, tip.y, tip.z = tip.s + share * gt, tip.y + share * gn, tip.z + share * gb
            tip.z = max(tip.z, groove.floor(tip.y)[0])
            continue
        tip.touching = True
        press = max(0.0, -_STIFF[1] * gb)
        push = _STIFF[0] * gn
        seated = abs(tip.y) < 1e-7
        total = press / math.sin(HALF_ANGLE) if low < DROP - 1e-9 else press
        # Along the groove: sticks within the friction of both walls, else slides until it is at that edge.
        hold = friction * total / _STIFF[0]
        tip.s += math.copysign(max(0.0, abs(gt) - hold), gt) / (1.0 - f.curvature * tip.y)
        # Across: the slope of the floor turns the axial spring into a lateral force; at the seat both walls share it.
        if seated and abs(push) <= press / math.tan(HALF_ANGLE):
            tip.y, tip.z = 0.0, 0.0
            continue
        drive = push - press * (math.copysign(1.0 / math.tan(HALF_ANGLE), push) if seated else slope)
        drag = friction * press * math.sqrt(1.0 + slope * slope)
        if abs(drive) <= drag:
            tip.z = low
            continue
        stiff = _STIFF[0] + _STIFF[1] * slope * slope
        move = share * math.copysign(abs(drive) - drag, drive) / stiff
        y = tip.y + max(-0.3e-3, min(0.3e-3, move))
        tip.y = 0.0 if y * tip.y < 0.0 else y
        tip.z = groove.floor(tip.y)[0]
    f = groove.line.frame(tip.s)
    rough = 0.0
    if len(groove.rough) > 2 and tip.touching:
        rough = float(np.interp(tip.s, np.linspace(0.0, groove.line.length, len(groove.rough)), groove.rough))
    return f.position + (tip.y + rough) * f.normal + tip.z * f.up


@dataclass(frozen=True)
class Run:
    """A simulated weld, one row per tick."""

    time: Array
    torch: Array
    tool: Array
    tip: Array
    torch_on: Array
    phase: tuple[Phase, ...]
    commands: tuple[WeldingCommand, ...]
    state: WeldingState

    @property
    def last(self) -> WeldingCommand:
        return self.commands[-1]

    def phases(self) -> tuple[Phase, ...]:
        """The phases in order, each told once per visit."""
        return tuple(p for i, p in enumerate(self.phase) if i == 0 or p != self.phase[i - 1])


def straight(length: float = 0.3) -> Array:
    """Points of a straight root line."""
    x = np.linspace(0.0, length, 61)
    return np.column_stack([x, 0.0 * x, 0.0 * x])


def arcs(*pieces: tuple[float, float], spacing: float = 1e-3) -> Array:
    """Points of a plane curve from (length m, curvature 1/m) pieces, starting along x."""
    points, heading, p = [np.zeros(3)], 0.0, np.zeros(3)
    for length, curvature in pieces:
        n = max(4, round(length / spacing))
        for _ in range(n):
            middle = heading + 0.5 * curvature * length / n
            chord = length / n * (np.sinc(0.5 * curvature * length / n / np.pi))
            p = p + chord * np.array([math.cos(middle), math.sin(middle), 0.0])
            heading += curvature * length / n
            points.append(p)
    return np.array(points)


def s_curve(radius: float = 0.060, turn: float = math.radians(60.0)) -> Array:
    """An S of 300 mm: straight, left, right, straight."""
    bend = radius * turn
    rest = 0.5 * (0.3 - 3.0 * bend)
    return arcs(
        (rest, 0.0),
        (bend / 2, 1 / radius),
        (bend, -1 / radius),
        (bend, 1 / radius),
        (bend / 2, -1 / radius),
        (rest, 0.0),
    )


def l_curve(radius: float = 0.020, side: float = -1.0) -> Array:
    """An L of 300 mm turning by 90 deg, to the right when side is -1."""
    bend = radius * math.pi / 2
    return arcs((0.5 * (0.3 - bend), 0.0), (bend, side / radius), (0.5 * (0.3 - bend), 0.0), spacing=0.5e-3)


def planned(points: Array, budget: Budget, rng: np.random.Generator) -> SeamCurve:
    """What vision makes of the root line: warped, turned and shifted."""
    n = len(points)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    true = SeamCurve.from_points(points)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    warp = sum(np.sin(2.0 * np.pi * s * k / s[-1] + phase[k - 1]) / k for k in (1, 2, 3))
    warp = budget.plan_warp_m * warp / max(1e-12, float(np.max(np.abs(warp))))
    bent = points + warp[:, None] * true.normal(np.minimum(s, true.length))
    angle = budget.plan_angle_rad * rng.choice([-1.0, 1.0])
    heading = rng.uniform(0.0, 2.0 * np.pi)
    shift = budget.plan_shift_m * np.array([math.cos(heading), math.sin(heading), 0.0])
    shift[2] = budget.plan_height_m * rng.choice([-1.0, 1.0])
    middle = points[n // 2]
    R = RotationMatrix.MakeZRotation(angle).matrix()
    return SeamCurve.from_points((bent - middle) @ R.T + middle + shift)


def weld(
    points: Array,
    budget: Budget = NOMINAL,
    config: ServoConfig | None = None,
    seed: int = 0,
    gaps: tuple[tuple[float, float], ...] = (),
    hidden: tuple[float, float] = (math.inf, math.inf),
    plan: SeamCurve | None = None,
    time_limit: float = 90.0,
    up: Array | None = None,
) -> Run:
    """Run a whole weld of the groove with root line `points`; the tag is hidden between the two times given."""
    rng = np.random.default_rng(seed)
    settings = config or ServoConfig()
    settings = replace(settings, tool=replace(settings.tool, tip_seat_height_m=SEAT, tip_drop_m=DROP))
    root = SeamCurve.from_points(points, (0.0, 0.0, 1.0) if up is None else up)
    rough = np.zeros(2)
    if budget.roughness_m:
        rough = (
            np.convolve(rng.normal(size=int(root.length / 1e-3)), np.ones(2) / math.sqrt(2.0), "same")
            * budget.roughness_m
        )
    groove = Groove(root.raised(SEAT), gaps, rough)
    plan = plan or planned(points, budget, rng)
    dt = settings.period_s
    X_BT = touch_start_pose(plan, settings)
    R, p = X_BT.rotation().matrix(), np.array(X_BT.translation())
    s0 = float(groove.line.project(p))
    f = groove.line.frame(s0)
    tip = Tip(s0, float((p - f.position) @ f.normal), float((p - f.position) @ f.up))
    state, V = WeldingState(), np.zeros(6)
    yaw = RotationMatrix.MakeZRotation(budget.tag_yaw_rad).matrix()
    queue: list[DeflectionSample] = []
    newest: DeflectionSample | None = None
    next_frame, rows, commands, phases = 0.0, [], [], []
    blend = 1.0 if budget.lag_s <= 0.0 else 1.0 - math.exp(-dt / budget.lag_s)
    stopped = 0
    for k in range(int(time_limit / dt)):
        t = k * dt
        centre = step_tip(tip, p, groove, budget.friction, dt)
        X_BT = RigidTransform(RotationMatrix(R), p)
        if t >= next_frame - 1e-9:
            next_frame += 1.0 / 30.0
            deflection = yaw @ (budget.gain * (R.T @ (centre - p))) + rng.normal(0.0, 1.0, 3) * budget.tag_sigma_m
            queue.append(DeflectionSample(t, X_BT, deflection, not hidden[0] <= t < hidden[1]))
        while queue and queue[0].capture_time + budget.latency_s <= t + 1e-9:
            newest = queue.pop(0)
        state, command = welding_step(state, ServoSample(t, X_BT, newest), plan, settings)
        commands.append(command)
        phases.append(command.phase)
        rows.append((t, *(p + R @ settings.p_TW), *p, *centre))
        stopped = stopped + 1 if command.phase in (Phase.DONE, Phase.FAULT) else 0
        if stopped > 40:
            break
        V = V + blend * (command.V_BT - V)
        angle = float(np.linalg.norm(V[:3])) * dt
        if angle > 1e-12:
            w = V[:3] / np.linalg.norm(V[:3])
            K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
            R = (np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K) @ R
            if k % 50 == 0:
                R = np.array(RotationMatrix.ProjectToRotationMatrix(R).matrix())
        p = p + V[3:] * dt
    table = np.array(rows)
    on = np.array([c.torch_on for c in commands])
    return Run(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:10], on, tuple(phases), tuple(commands), state)
