"""Random placements of part, tool and arm: whether the path check accepts them, and how the arm then follows the
seam."""

import math
import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.worlds.weld.budgets import NOMINAL, planned_seam
from tests.worlds.weld.plant import groove_config, simulate
from tests.worlds.weld.seams import TrueSeam, arcs, corner
from weldcal.models.arms.compiled_kinematics import tick_flange_pose, tick_jacobian
from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.tool import LAST_LINK, Placed, WeldingTool
from weldcal.systems.jobs.weld.arm_way import SeamOutOfReach, Welder, arm_waypoints, find_way, way_on
from weldcal.systems.motion.guarded_path import LEAST_SHARE, InfeasiblePath
from weldcal.systems.motion.spine import ACCELERATION_SHARE, JERK_LIMIT
from weldcal.systems.motion.spine import SPEED_SHARE as SLEW_SHARE
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.feasibility import InfeasibleSeam, check_feasible
from weldcal.welding.servo.guards import GUARD, SPEED_SHARE, SlewLimits, guarded_joint_velocity, slew_limit
from weldcal.welding.servo.settings import ServoConfig, ToolGeometry, TouchOnConfig
from weldcal.welding.servo.state import Phase

ARMS = ("ur3e", "ur5e", "ur7e", "ur10e", "ur12e", "ur16e", "ur20")
SLEW_S = 0.002
STANDSTILL = 0.02  # share of the commanded speed


@dataclass(eq=False, kw_only=True)
class GuardedArm:
    """An arm that follows velocities of T through the guard and the slew limiter, without mass."""

    arm: ArmModel
    X_FT: RigidTransform
    q: Array
    slowest: float = 1.0
    least_sigma: float = math.inf
    v: Array = field(default_factory=lambda: np.zeros(6))
    a: Array = field(default_factory=lambda: np.zeros(6))

    @cached_property
    def limits(self) -> SlewLimits:
        """Those of the spine."""
        arm = self.arm
        return SlewLimits(
            *SlewLimits(SLEW_SHARE * arm.velocity_limit, ACCELERATION_SHARE * arm.acceleration_limit, JERK_LIMIT).rows(
                6
            )
        )

    def __call__(self, V: Array, dt: float) -> tuple[Array, Array, str | None]:
        """See plant.Carrier."""
        arm = self.arm
        J = tick_jacobian(arm, self.q, np.array(self.X_FT.translation()))
        found = guarded_joint_velocity(J, V, SPEED_SHARE * arm.velocity_limit, GUARD)
        self.slowest, self.least_sigma = min(self.slowest, found.scale), min(self.least_sigma, found.sigma_min)
        for _ in range(round(dt / SLEW_S)):
            self.v, self.a = slew_limit(found.q_dot, self.v, self.a, self.limits, SLEW_S)
            self.q = self.q + SLEW_S * self.v
        X_BT = tick_flange_pose(arm, self.q) @ self.X_FT
        out = bool(np.any(self.q > arm.position_upper) or np.any(self.q < arm.position_lower))
        reason = "guard" if found.scale < STANDSTILL else "joint limit" if out else None
        return np.array(X_BT.rotation().matrix()), np.array(X_BT.translation()), reason


@dataclass(frozen=True, eq=False)
class Placement:
    """A seam in the base, its plan, and what welds it."""

    seam: TrueSeam
    plan: SeamCurve
    welder: Welder


def draw(seed: int) -> Placement:
    """Draw an arm, a tool, a seam and its place, some of them out of reach or near a singular position."""
    rng = np.random.default_rng([seed, 42])
    arm = load_arm(ARMS[int(rng.integers(len(ARMS)))])
    reach = abs(arm.dh.a2) + abs(arm.dh.a3)
    lean = RollPitchYaw(*rng.uniform(-0.6, 0.6, 2), rng.uniform(-math.pi, math.pi)).ToRotationMatrix()
    R_FT = RollPitchYaw(RotationMatrix(RollPitchYaw(math.pi, 0.0, 0.0)) @ lean).vector()
    at = (*rng.uniform(-0.06, 0.06, 2).tolist(), float(rng.uniform(0.12, 0.25)))
    chord_m = float(rng.uniform(0.04, 0.08))
    tool = WeldingTool(chord_m=chord_m, tip_pose=Placed(at, (float(R_FT[0]), float(R_FT[1]), float(R_FT[2]))))
    body = tuple(Capsule(LAST_LINK, np.zeros(3), end, 0.015) for end in (np.array(at), tool.X_FT @ tool.p_TW))
    tool = replace(tool, keep_clear=body)
    points = _seam(rng)
    points = points - points.mean(axis=0)
    angle, tilt = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 0.15 if rng.random() < 0.5 else 1.2)
    turn = RollPitchYaw(0.0, 0.0, rng.uniform(-math.pi, math.pi)).ToRotationMatrix()
    axis = RollPitchYaw(0.0, 0.0, rng.uniform(-math.pi, math.pi)).ToRotationMatrix()
    R = (axis @ RollPitchYaw(tilt, 0.0, 0.0).ToRotationMatrix() @ axis.inverse() @ turn).matrix()
    r, z = reach * rng.uniform(0.15, 1.2), reach * rng.uniform(-0.3, 0.6)
    p = np.array([r * math.cos(angle), r * math.sin(angle), z])
    seam = TrueSeam("placed", points @ R.T + p, R[:, 2])
    config = ServoConfig(
        tool=ToolGeometry(torch_offset_m=chord_m, torch_height_m=tool.torch_height_m),
        touch=TouchOnConfig(zero_frames=10),
        weld_speed_m_s=float(rng.uniform(0.010, 0.020)),
    )
    pan = (angle + rng.uniform(-0.8, 0.8) + math.pi) % (2.0 * math.pi) - math.pi
    home = np.r_[pan, np.deg2rad([-80.0, 110.0, -120.0, -90.0, 0.0])]
    welder = Welder(arm=arm, tool=tool, config=groove_config(config), q_near=home, clearance_m=0.025)
    return Placement(seam, planned_seam(seam, NOMINAL, np.random.default_rng(seed)), welder)


def _seam(rng: np.random.Generator) -> Array:
    kind, length = int(rng.integers(4)), float(rng.uniform(0.08, 0.16))
    if kind == 0:
        return arcs((length, 0.0), spacing=2e-3)
    if kind == 1:
        return arcs((length, float(rng.choice([-1.0, 1.0]) / rng.uniform(0.1, 0.4))))
    if kind == 2:
        return arcs((0.5 * length, 1.0 / 0.06), (0.5 * length, -1.0 / 0.06))
    return corner(0.02, 90.0, float(rng.choice([-1.0, 1.0])), legs=0.5 * length)


def placed(seed: int, drive: bool = True) -> dict[str, Any]:
    """Check one placement and drive it, a refused one only where its seed is even: what the check says, and how the
    drive ends.

    `state` is accepted, refused, or unsuitable (the seam itself cannot be welded in one go). `end` is done, guard
    (stopped, or slowed to a standstill), joint limit, slowed (below LEAST_SHARE of the speed), fault (of the servo), or
    no start (no pose above the seam).
    """
    placement = draw(seed)
    welder, plan = placement.welder, placement.plan
    row: dict[str, Any] = {"arm": welder.arm.name, "state": "accepted", "reason": "", "end": ""}
    try:
        check_feasible(plan, welder.tool.chord_m, welder.config.weld_speed_m_s)
    except InfeasibleSeam as problem:
        return row | {"state": "unsuitable", "reason": str(problem)}
    try:
        q = way_on(welder, plan, None, 0.0, None).q_start
    except InfeasiblePath as problem:
        row |= {"state": "refused", "reason": problem.problem}
        try:
            q = arm_waypoints(welder.arm, welder.tool, plan, welder.config, welder.q_near, welder.clearance_m)[0]
        except SeamOutOfReach:
            return row | {"end": "no start"}
        drive = drive and seed % 2 == 0
    return row | (follow(placement, q, seed) if drive else {})


def follow(placement: Placement, q_start: Array, seed: int) -> dict[str, Any]:
    """Drive the arm from the touch to the seam's end with the servo, the guard and the slew limiter."""
    welder = placement.welder
    carrier = GuardedArm(arm=welder.arm, X_FT=welder.tool.X_FT, q=q_start)
    run = simulate(placement.seam, NOMINAL, welder.config, seed, plan=placement.plan, carrier=carrier)
    end = "done" if run.phase == Phase.DONE else run.reason if run.reason in ("guard", "joint limit") else "fault"
    if end == "done" and carrier.slowest < LEAST_SHARE:
        end = "slowed"
    return {
        "end": end,
        "fault": run.reason or "",
        "share": carrier.slowest,
        "sigma": carrier.least_sigma,
        "time_s": float(run.column("time_s")[-1]),
    }


def offered(seed: int) -> str:
    """What the check says of a placement, with the change that it offers."""
    placement = draw(seed)
    try:
        find_way(placement.welder, placement.plan, None)
    except InfeasiblePath as problem:
        return str(problem)
    return ""


def main(first: int, last: int) -> None:
    """Print how many placements of the seeds first to last - 1 are accepted and refused, how the drives end, and what
    disagrees."""
    ends: Counter[tuple[str, str]] = Counter()
    for seed in range(first, last):
        row = placed(seed)
        ends[row["state"], row["end"]] += 1
        if (row["state"], row["end"]) in [
            ("refused", "done"),
            *(("accepted", end) for end in ("guard", "joint limit", "slowed", "fault")),
        ]:
            print(seed, row)
    for (state, end), count in sorted(ends.items()):
        print(f"{state:10} {end or 'not driven':12} {count}")


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:3]))
