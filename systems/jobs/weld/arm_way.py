"""Plans the arm's way to a seam, along it and back, and searches for the change that makes an infeasible one feasible."""

import dataclasses as dc
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.planning.clearance import Body, arm_bodies, path_clearance
from weldcal.calibration.planning.surroundings import Obstacle, Surroundings
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.systems.motion.guarded_path import Followed, GuardedMotion, InfeasiblePath, check_path, straight
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.room import NoRoom, check_room
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.tool_axes import tool_path
from weldcal.welding.servo.touch import touch_start_pose

CHECKED_EVERY = 5  # places of the seam, against the surroundings: 20 mm
CLEAR_OF_PART_M = 0.002
HIGHER = (1.0, 2.0, 4.0)  # of the clearance above the seam, until the moves are clear
LEAN_STEP_DEG, LEAN_MOST_DEG = 2.0, 10.0
MOVES_MM, TURNS_DEG = (25.0, 50.0, 100.0, 150.0, 200.0, 300.0), (15.0, 30.0, 45.0, 60.0, 90.0, 180.0)
MM_PER_DEG = 2.0  # of an offered turn, beside an offered move
_LEVEL = math.cos(math.radians(20.0))
_POSTURES = 24


class SeamObstructed(InfeasiblePath):
    """Something is in the arm's way along the seam."""


class SeamOutOfReach(InfeasiblePath):
    """The arm cannot hold the tool at the seam."""


class ArmWay(NamedTuple):
    """Joints (6,) rad at the touch's start, above it and above the far end; how far the tool leans, rad; and the seam in joints."""

    q_start: Array
    q_above: Array
    q_retract: Array
    lean_rad: float
    along: tuple[Followed, ...]


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Welder:
    """What follows a seam: arm, tool and servo, home, the cell around them, and what the job may change by itself.

    Attributes:
        arm, tool, config: as in SeamPlanning.
        q_home: (6,) rad.
        clearance_m: of the approach above the seam.
        surroundings: obstacles.
        part: the part's mesh in its own frame; None: no move is checked against it.
        table_z_m: height of the table over the base, m, for a move to another branch.
        lean_rad: largest lean across the chord that the job may use by itself.
        any_posture: whether the job may weld on another branch than that of home.
    """

    arm: ArmModel
    tool: WeldingTool
    config: ServoConfig
    q_home: Array
    clearance_m: float
    surroundings: Surroundings = dc.field(default_factory=Surroundings)
    part: TriMesh | None = None
    table_z_m: float = 0.0
    lean_rad: float = 0.0
    any_posture: bool = False

    def leaning(self, lean_rad: float) -> ServoConfig:
        """The servo's settings with a lean."""
        return leaning(self.config, lean_rad)


def leaning(config: ServoConfig, lean_rad: float) -> ServoConfig:
    """Settings of a servo that leans the tool."""
    return dc.replace(config, torch=dc.replace(config.torch, work_angle_rad=lean_rad)) if lean_rad else config


def find_way(welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None) -> ArmWay:
    """The first way that works, of the upright tool on the branch of home and of what else the job may use by itself.

    Raises:
        InfeasiblePath: of the first of them, with the change that makes the seam feasible where one was found.
    """
    first: InfeasiblePath | None = None
    may = math.degrees(welder.lean_rad) + 1e-6
    leans = [lean for lean in _LEANS if abs(math.degrees(lean)) <= may]
    ways = itertools.chain(((lean, None) for lean in leans), _postures(welder, seam) if welder.any_posture else ())
    for lean, seed in ways:
        try:
            return way_on(welder, seam, X_BP, lean, seed)
        except InfeasiblePath as problem:
            first = first or problem
    assert first is not None
    raise first.advised(_offer(welder, seam, X_BP, may)) from first


_LEANS = sorted(np.radians(np.arange(-LEAN_MOST_DEG, LEAN_MOST_DEG + 1.0, LEAN_STEP_DEG)).tolist(), key=abs)


def _offer(welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None, may_deg: float) -> str:
    """The cheapest change that makes a seam feasible: a lean, another branch, or another place of the part."""

    def works(X: RigidTransform, lean: float = 0.0, seed: Array | None = None) -> bool:
        try:
            way_on(welder, seam.transformed(X), None if X_BP is None else X @ X_BP, lean, seed)
        except InfeasiblePath:
            return False
        return True

    still = RigidTransform()
    for lean in _LEANS:
        if abs(math.degrees(lean)) > may_deg and works(still, lean):
            return f"set welding.lean_deg: {abs(math.degrees(lean)):.0f}, with which the tool leans sideways so far where it must"
    if not welder.any_posture and any(works(still, lean, seed) for lean, seed in _postures(welder, seam)):
        return "set welding.posture: any, with which the arm changes to another branch above the part"
    for X, words in _displacements(seam.frame(0.5 * seam.length).position, welder.arm.up):
        if works(X):
            return words
    return "no move of the part by up to 300 mm and no turn makes it feasible; choose another place or a longer arm"


def _displacements(centre: Array, up: Array) -> Iterator[tuple[RigidTransform, str]]:
    """Moves and turns of the part in the base, the cheapest first, each with its sentence."""
    found = []
    level = [d for d in itertools.product((-1, 0, 1), repeat=3) if abs(d[0]) + abs(d[1]) + abs(d[2]) in (1, 2)]
    for mm, d in itertools.product(MOVES_MM, level):
        way = mm * np.array(d)
        words = f"move the part by {way[0]:+.0f}, {way[1]:+.0f}, {way[2]:+.0f} mm along x, y, z of the base"
        found.append((float(np.linalg.norm(way)), RigidTransform(1e-3 * way), words))
    for deg, sign in itertools.product(TURNS_DEG, (1.0, -1.0)):
        X = _about(centre, sign * math.radians(deg) * up)
        at = f"{1e3 * centre[0]:.0f}, {1e3 * centre[1]:.0f}"
        words = f"turn the part by {sign * deg:+.0f} deg about the vertical through the seam's middle (x, y of the base {at} mm)"
        found.append((MM_PER_DEG * deg, X, words))
    return ((X, words) for _, X, words in sorted(found, key=lambda item: item[0]))


def _about(centre: Array, turn: Array) -> RigidTransform:
    angle = float(np.linalg.norm(turn))
    R = RotationMatrix(AngleAxis(angle, turn / angle))
    return RigidTransform(R, centre - R.multiply(centre))


def _postures(welder: Welder, seam: SeamCurve) -> Iterator[tuple[float, Array]]:
    """Every other branch above the seam's start, whole turns of a joint included, the nearest to home first."""
    arm, above = welder.arm, _lifted(welder, seam, 0.0, welder.clearance_m)
    near = nearest_solution(arm, above, welder.q_home)
    found: list[Array] = []
    for q in inverse_kinematics(arm, above):
        q = q + 2.0 * np.pi * np.round((welder.q_home - q) / (2.0 * np.pi))
        turned = [q + sign * 2.0 * np.pi * np.eye(6)[k] for k in (0, 3, 4, 5) for sign in (1.0, -1.0)]
        found += [p for p in (q, *turned) if np.all((p > arm.position_lower) & (p < arm.position_upper))]
    others = (q for q in found if near is None or float(np.abs(q - near).max()) > 0.1)
    ranked = sorted(others, key=lambda q: float(np.sum(((q - welder.q_home) / arm.velocity_limit) ** 2)))
    return ((0.0, q) for q in ranked[:_POSTURES])


def way_on(welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None, lean: float, seed: Array | None) -> ArmWay:
    """The checked way with a lean, on the branch of `seed` (6,) above the seam's start, else that of home."""
    config, problem, along = welder.leaning(lean), None, None
    for share in HIGHER:
        try:
            q_near = welder.q_home if seed is None else seed
            goals = arm_waypoints(welder.arm, welder.tool, seam, config, q_near, share * welder.clearance_m)
            along = along or tuple(check_path(welder.arm, goals[0], seam_motions(welder.tool, seam, config)))
            way = ArmWay(*goals, lean, along)
            _check_clear(welder, way, X_BP, seed is not None)
            break
        except (SeamObstructed, SeamOutOfReach) as found:
            problem = (
                problem or found
            )  # what is in the way at the first height, not that the arm does not reach a higher one
            if share == HIGHER[-1] or isinstance(problem, SeamOutOfReach):
                raise problem from found
    if lean and welder.part is not None and X_BP is not None:
        tool = welder.tool
        try:
            check_room(welder.part, X_BP, seam, tool.capsules(), tool.X_FT, tool.chord_m, lean)
        except NoRoom as problem:
            raise SeamObstructed(str(problem)) from problem
    return way


def seam_motions(tool: WeldingTool, seam: SeamCurve, config: ServoConfig) -> list[GuardedMotion]:
    """The search for the groove, to its deepest and farthest, and the seam, as the servo moves the tool."""
    X, touch = touch_start_pose(seam, config), config.touch
    y, z = (X.rotation().matrix()[:, k] for k in (1, 2))
    down = config.tool.tip_drop_m + touch.height_m + touch.depth_m + config.deflection.axial_d_m
    deep = RigidTransform(X.rotation(), X.translation() - down * z)
    path = tool_path(seam, config)
    return [
        straight("the descent to the seam", X, -down * z, touch.fast_m_s, tool.X_FT),
        straight("the search for the seam", deep, touch.range_m * y, touch.search_m_s, tool.X_FT),
        GuardedMotion(
            name="the seam",
            X_BT=path.X_BT,
            time=path.time,
            X_FT=tool.X_FT,
            along=np.maximum(path.s_torch, 0.0),
            weave_rad_s=config.weave.peak_speed_m_s / config.tool.torch_offset_m,
        ),
    ]


def _check_clear(welder: Welder, way: ArmWay, X_BP: RigidTransform | None, elsewhere: bool) -> None:
    """Check that the whole way keeps the arm and its tool clear of the surroundings, of itself and of the part.

    A move to another branch is also checked against the table.

    Raises:
        SeamObstructed: with the place.
    """
    arm, bodies, seam = welder.arm, arm_bodies(welder.arm, welder.tool.capsules()), way.along[-1]
    places = [*range(0, len(seam.q) - 1, CHECKED_EVERY), len(seam.q) - 1]
    weld = [
        (f"at {1e3 * seam.along[b]:.0f} mm of the seam", seam.q[a], seam.q[b]) for a, b in itertools.pairwise(places)
    ]
    to, back = (
        ("on its way to the seam", welder.q_home, way.q_above),
        ("on its way from the seam", way.q_retract, welder.q_home),
    )
    for where, a, b in (
        to,
        ("above the seam", way.q_above, way.q_start),
        *weld,
        ("above the seam's end", seam.q[-1], way.q_retract),
        back,
    ):
        lowest, gap = path_clearance(arm, bodies, a, b)
        name = welder.surroundings.touched_on_path(arm, bodies, a, b) or ("the arm itself" if gap <= 0.0 else "")
        if not name and elsewhere and where in (to[0], back[0]) and lowest <= welder.table_z_m:
            name = "the table"
        if name:
            raise SeamObstructed(
                f"The arm or its tool would come too close to '{name}' {where}",
                "move it or the workpiece, or correct surroundings in the scenario",
            )
    if X_BP is not None and welder.part is not None:
        _check_part(welder, Obstacle("part", welder.part.transformed(X_BP), CLEAR_OF_PART_M), bodies, (to, back))


def _check_part(
    welder: Welder, part: Obstacle, bodies: list[Body], moves: tuple[tuple[str, Array, Array], ...]
) -> None:
    for where, a, b in moves:
        if Surroundings((part,)).touched_on_path(welder.arm, bodies, a, b):
            raise SeamObstructed(
                f"The arm or its tool would touch the part {where}, even {1e3 * HIGHER[-1] * welder.clearance_m:.0f} mm above the seam",
                "choose another home_deg, or turn the part",
            )


def _lifted(welder: Welder, seam: SeamCurve, lean: float, clearance_m: float) -> RigidTransform:
    """Pose of the flange above the seam's start."""
    X_BT = touch_start_pose(seam, welder.leaning(lean))
    up = clearance_m * _away(seam.frame(0.0).up, welder.arm.up)
    return RigidTransform(X_BT.rotation(), X_BT.translation() + up) @ welder.tool.X_FT.inverse()


def arm_waypoints(
    arm: ArmModel, tool: WeldingTool, seam: SeamCurve, config: ServoConfig, q_near: Array, clearance_m: float
) -> tuple[Array, Array, Array]:
    """Joint positions (6,) rad at the touch start, above it, and above the far end.

    Raises:
        SeamOutOfReach: where no inverse kinematics solution exists.
    """
    X_BT = touch_start_pose(seam, config)
    solutions = []
    q = q_near
    end = seam.frame(seam.length)
    lifted = RigidTransform(X_BT.rotation(), X_BT.translation() + clearance_m * _away(seam.frame(0.0).up, arm.up))
    X_BE = RigidTransform(X_BT.rotation(), end.position + (clearance_m + 0.05) * _away(end.up, arm.up))
    for where, pose in (("above its start", lifted), ("at its start", X_BT), ("above its end", X_BE)):
        X_BF = pose @ tool.X_FT.inverse()
        found = nearest_solution(arm, X_BF, q)
        if found is None:
            far = float(np.linalg.norm(X_BF.translation())) > 0.5 * (abs(arm.dh.a2) + abs(arm.dh.a3))
            joint, to = ("elbow", "towards") if far else ("shoulder pan", "away from")
            raise SeamOutOfReach(
                f"The arm cannot reach the seam {where}, with the {joint} at its end",
                f"move the workpiece {to} the robot",
            )
        solutions.append(found)
        q = found
    q_above, q_start, q_retract = solutions
    return q_start, q_above, q_retract


def _away(up: Array, vertical: Array) -> Array:
    """Direction (3,) out of a joint: vertical on a level face, along the bisector of a leaning joint."""
    return vertical if float(up @ vertical) > _LEVEL else up
