"""Plan the arm's way to a seam, along it and back, and search for the change that makes it feasible."""

import dataclasses as dc
import itertools
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.planning.clearance import Obstacle, Surroundings, arm_bodies, path_clearance, self_distance
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arrays import Array
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.motion.guarded_path import Followed, GuardedMotion, InfeasiblePath, check_path, straight
from weldcal.welding.passes.tacks import BESIDE_M
from weldcal.welding.seam.clearance import NoClearance, check_clearance
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.tool_axes import tool_path
from weldcal.welding.servo.touch import touch_start_pose

CHECKED_EVERY = 5  # places of the seam, against the surroundings: 20 mm
CLEAR_OF_PART_M = 0.002  # twice the tool's own clearance: the arm's links are capsules, with errors of their own
HIGHER = (1.0, 2.0, 4.0)  # of the clearance above the seam, until the moves are clear
LEAN_STEP_DEG, LEAN_MOST_DEG = 2.0, 10.0
MOVES_MM, TURNS_DEG = (25.0, 50.0, 100.0, 150.0, 200.0, 300.0), (15.0, 30.0, 45.0, 60.0, 90.0, 180.0)
MM_PER_DEG = 2.0  # of an offered turn, beside an offered move
_LEVEL = math.cos(math.radians(20.0))
_POSTURES = 24
TURNED_RAD = math.pi


class SeamObstructed(InfeasiblePath):
    """Something is in the arm's way along the seam."""


class SeamOutOfReach(InfeasiblePath):
    """The arm cannot hold the tool at the seam."""


class ArmWay(NamedTuple):
    """Joints (6,) rad at the touch's start, above it and above the far end.

    How far the tool leans, rad; and the seam in joints.
    """

    q_start: Array
    q_above: Array
    q_retract: Array
    lean_rad: float
    along: tuple[Followed, ...]

    @property
    def reached(self) -> dict[str, Any]:
        """The joints and the lean by their names in a PlannedSeam."""
        return {name: getattr(self, name) for name in self._fields if name != "along"}


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Welder:
    """What follows a seam: arm, tool and servo, home, the cell around them, and what the job may change by itself.

    Attributes:
        arm, tool, config: the arm, the tool on its flange, and the servo's settings.
        q_near: (6,) rad, home.
        clearance_m: of the approach above the seam.
        workpiece: the nominal part; None: no move is checked against it.
        surroundings: obstacles.
        table_z_m: height of the table over the base, m, for a move to another branch.
        lean_rad: largest lean across the chord that the job may use by itself.
        any_posture: whether the job may weld on another branch than that of home.
        advises: whether to look for the change that makes an infeasible seam feasible; this takes seconds.
    """

    arm: ArmModel
    tool: WeldingTool
    config: ServoConfig
    q_near: Array
    clearance_m: float
    workpiece: WeldPart | None = None
    surroundings: Surroundings = dc.field(default_factory=Surroundings)
    table_z_m: float = 0.0
    lean_rad: float = 0.0
    any_posture: bool = False
    advises: bool = True


def leaning(
    config: ServoConfig,
    lean_rad: float,
    touch_arc_m: float | None = None,
    sigma_m: float = math.nan,
    begins_m: float = 0.0,
) -> ServoConfig:
    """Settings of a servo that leans the tool, whose tip comes down elsewhere, and whose plan has a sigma.

    Of a plan that begins later on the whole seam, the tacks are at other places, and behind the tip there are none.
    """
    if math.isfinite(sigma_m):
        # Two sigma above its plan is the root still likely; anything else that holds the ball there is refused.
        above_m = min(max(2.0 * sigma_m, 0.5 * config.tool.tip_drop_m), config.touch.above_m)
        config = dc.replace(config, touch=dc.replace(config.touch, above_m=above_m))
    if touch_arc_m is not None:
        ahead = [tack for tack in config.tacks if tack.end - begins_m + BESIDE_M > touch_arc_m]
        tacks = tuple(dc.replace(tack, start=tack.start - begins_m, end=tack.end - begins_m) for tack in ahead)
        config = dc.replace(config, touch=dc.replace(config.touch, arc_m=touch_arc_m), tacks=tacks)
    return dc.replace(config, torch=dc.replace(config.torch, work_angle_rad=lean_rad)) if lean_rad else config


def leans_with_clearance(welder: Welder, seam: SeamCurve, X_BP: RigidTransform) -> list[float]:
    """Leans, rad, that the job may use and with which the tool's body fits the part.

    The upright tool's only where that fits.

    Raises:
        NoClearance: none fits, with the least lean that would.
    """
    assert welder.workpiece is not None
    mesh, tool, refused, fits = welder.workpiece.mesh, welder.tool, None, []
    for lean in LEANS:
        try:
            check_clearance(mesh, X_BP, seam, tool.capsules(), tool.X_FT, tool.chord_m, lean)
        except NoClearance as problem:
            refused = refused or problem
            continue
        if refused is None:
            return [lean for lean in LEANS if abs(lean) <= welder.lean_rad + 1e-6]
        fits.append(lean)
    assert refused is not None
    if may := [lean for lean in fits if abs(lean) <= welder.lean_rad + 1e-6]:
        return may
    if not fits:
        raise refused
    advice = f"set welding.lean_deg: {abs(math.degrees(fits[0])):.0f}, with which the tool leans so far where it must"
    raise NoClearance(f"{refused} Or {advice}.", refused.short_m)


def find_way(
    welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None, leans: Sequence[float] | None = None
) -> ArmWay:
    """The first way that works, of the upright tool on the branch of home and of what else the job may use by itself.

    ``leans``: with which the tool has room at the part; None: as far as the job may.

    Raises:
        InfeasiblePath: of the first of them, with the change that makes the seam feasible where one was found.
    """
    first: InfeasiblePath | None = None
    may = math.degrees(welder.lean_rad) + 1e-6
    leans = [lean for lean in LEANS if abs(math.degrees(lean)) <= may] if leans is None else leans
    others = _postures(welder, seam, welder.any_posture) if 0.0 in leans else ()
    ways = itertools.chain(((lean, None) for lean in leans), others)
    for lean, seed in ways:
        try:
            return way_on(welder, seam, X_BP, lean, seed)
        except InfeasiblePath as problem:
            first = first or problem
    assert first is not None
    if not welder.advises:
        raise first
    raise first.advised(_offer(welder, seam, X_BP, may)) from first


LEANS = sorted(np.radians(np.arange(-LEAN_MOST_DEG, LEAN_MOST_DEG + 1.0, LEAN_STEP_DEG)).tolist(), key=abs)


def _offer(welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None, may_deg: float) -> str:
    """The cheapest change that makes a seam feasible: a lean, another branch, or another place of the part."""

    def works(X: RigidTransform, lean: float = 0.0, seed: Array | None = None) -> bool:
        try:
            way_on(welder, seam.transformed(X), None if X_BP is None else X @ X_BP, lean, seed)
        except InfeasiblePath:
            return False
        return True

    still = RigidTransform()
    for lean in LEANS:
        if abs(math.degrees(lean)) > may_deg and works(still, lean):
            return (
                f"set welding.lean_deg: {abs(math.degrees(lean)):.0f}, with which the tool leans sideways so far where"
                " it must"
            )
    if not welder.any_posture and any(works(still, lean, seed) for lean, seed in _postures(welder, seam, True)):
        return "set welding.posture: any, with which the arm changes to another branch above the part"
    for X, words in _displacements(seam.frame(0.5 * seam.length).position, welder.arm.up):
        if works(X):
            return words
    return "no move of the part by up to 300 mm and no turn makes it feasible; choose another place or a longer arm"


def _displacements(centre: Array, up: Array) -> Iterator[tuple[RigidTransform, str]]:
    """Moves and turns of the part in the base, the cheapest first, each with its sentence."""
    found = []
    for mm, d in itertools.product(MOVES_MM, itertools.product((-1, 0, 1), repeat=3)):
        if np.count_nonzero(d) in (1, 2):
            way = mm * np.array(d)
            words = "move the part by {:+.0f}, {:+.0f}, {:+.0f} mm along x, y, z of the base".format(*way)
            found.append((float(np.linalg.norm(way)), RigidTransform(1e-3 * way), words))
    for deg in (*TURNS_DEG, *(-deg for deg in TURNS_DEG)):
        R = RotationMatrix(AngleAxis(math.radians(deg), up))
        at = "x, y of the base {:.0f}, {:.0f} mm".format(*(1e3 * centre[:2]))
        words = f"turn the part by {deg:+.0f} deg about the vertical through the seam's middle ({at})"
        found.append((MM_PER_DEG * abs(deg), RigidTransform(R, centre - R.multiply(centre)), words))
    return ((X, words) for _, X, words in sorted(found, key=lambda item: item[0]))


def _postures(welder: Welder, seam: SeamCurve, any_branch: bool) -> Iterator[tuple[float, Array]]:
    """Every branch above the seam's start, or whole turns of wrist 3 only, the nearest to home first.

    Whole turns of a joint are included.
    """
    arm, home = welder.arm, welder.q_near
    above = _lifted(arm, seam, touch_start_pose(seam, welder.config), welder.clearance_m) @ welder.tool.X_FT.inverse()
    near, found = nearest_solution(arm, above, home), []
    for q in inverse_kinematics(arm, above):
        q = q + 2.0 * np.pi * np.round((home - q) / (2.0 * np.pi))
        turns = np.vstack([np.zeros(6), *(sign * 2.0 * np.pi * np.eye(6)[[0, 3, 4, 5]] for sign in (1.0, -1.0))])
        found += [p for p in q + turns if np.all((p > arm.position_lower) & (p < arm.position_upper))]
    others = [q for q in found if near is None or float(np.abs(q - near).max()) > 0.1]
    if not any_branch:
        others = [q for q in others if near is not None and np.abs(q - near)[:5].max() < 0.1]
    ranked = sorted(others, key=lambda q: float(np.sum(((q - home) / arm.velocity_limit) ** 2)))
    return ((0.0, q) for q in ranked[:_POSTURES])


def way_on(welder: Welder, seam: SeamCurve, X_BP: RigidTransform | None, lean: float, seed: Array | None) -> ArmWay:
    """The checked way with a lean, on the branch of `seed` (6,) above the seam's start, else that of home."""
    config, problem, along = leaning(welder.config, lean), None, None
    for share in HIGHER:
        try:
            q_near = welder.q_near if seed is None else seed
            goals = arm_waypoints(welder.arm, welder.tool, seam, config, q_near, share * welder.clearance_m)
            motions = seam_motions(welder.tool, seam, config)
            along = along or tuple(check_path(welder.arm, goals[0], motions))
            q_end = along[-1].q[-1]
            if float(np.abs(q_end - goals[2]).max()) > TURNED_RAD:  # around a ring: the wrist turns back above the part
                X_BE = _lifted(welder.arm, seam, motions[-1].X_BT[-1], share * welder.clearance_m + 0.05, seam.length)
                q_retract = nearest_solution(welder.arm, X_BE @ welder.tool.X_FT.inverse(), q_end)
                goals = (*goals[:2], goals[2] if q_retract is None else q_retract)
            way = ArmWay(*goals, lean, along)
            _check_clear(welder, way, X_BP, seed is not None)
            break
        except (SeamObstructed, SeamOutOfReach) as found:
            # what is in the way at the first height, not that the arm does not reach a higher one
            problem = problem or found
            if share == HIGHER[-1] or isinstance(problem, SeamOutOfReach):
                raise problem from found
    if lean and welder.workpiece is not None and X_BP is not None:
        tool = welder.tool
        try:
            check_clearance(welder.workpiece.mesh, X_BP, seam, tool.capsules(), tool.X_FT, tool.chord_m, lean)
        except NoClearance as problem:
            raise SeamObstructed(str(problem)) from problem
    return way


def seam_motions(tool: WeldingTool, seam: SeamCurve, config: ServoConfig) -> list[GuardedMotion]:
    """The search for the groove, to its deepest and farthest, and the seam, as the servo moves the tool."""
    X, touch = touch_start_pose(seam, config), config.touch
    lift = config.tool.tip_drop_m + touch.height_m
    y, z = (X.rotation().matrix()[:, k] for k in (1, 2))
    down = lift + touch.depth_m + config.deflection.axial_d_m if config.felt else lift
    deep = RigidTransform(X.rotation(), X.translation() - down * z)
    path = tool_path(seam, config)
    search = straight("the search for the seam", deep, touch.range_m * y, touch.search_m_s, tool.X_FT)
    return [
        straight("the descent to the seam", X, -down * z, touch.fast_m_s, tool.X_FT),
        *([search] if config.felt else []),
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
    """Check that the whole way is clear of the surroundings and of the arm itself, and the moves of the part.

    The moves to another branch and back are also checked against the table.

    Raises:
        SeamObstructed: with the place.
    """
    arm, home, bodies, seam = welder.arm, welder.q_near, arm_bodies(welder.arm, welder.tool.capsules()), way.along[-1]
    places = [*range(0, len(seam.q) - 1, CHECKED_EVERY), len(seam.q) - 1]
    moves = [("on its way to the seam", home, way.q_above), ("on its way from the seam", way.q_retract, home)]
    weld = [(f"at {1e3 * seam.along[b]:.0f} mm of the seam", seam.q[a], seam.q[b]) for a, b in pairwise(places)]
    ends = [("above the seam", way.q_above, way.q_start), ("above the seam's end", seam.q[-1], way.q_retract)]
    # the arm stands at home: as far as its capsules overlap there, they are larger than its bodies
    least = min(0.0, self_distance(bodies, link_frames(arm, home)))
    part = _part(welder, X_BP)
    for move in (*moves, *ends, *weld):
        where, a, b = move
        if move in moves and part.touched_on_path(arm, bodies, a, b):
            highest = f"{1e3 * HIGHER[-1] * welder.clearance_m:.0f} mm"
            problem = f"The arm or its tool would touch the part {where}, even {highest} above the seam"
            raise SeamObstructed(problem, "choose another home_deg, or turn the part")
        lowest, gap = path_clearance(arm, bodies, a, b)
        name = welder.surroundings.touched_on_path(arm, bodies, a, b) or ("the arm itself" if gap < least else "")
        if not name and elsewhere and move in moves and lowest <= welder.table_z_m:
            name = "the table"
        if name:
            problem = f"The arm or its tool would come too close to '{name}' {where}"
            raise SeamObstructed(problem, "move it or the workpiece, or correct surroundings in the scenario")


def _part(welder: Welder, X_BP: RigidTransform | None) -> Surroundings:
    if X_BP is None or welder.workpiece is None:
        return Surroundings()
    return Surroundings((Obstacle("part", welder.workpiece.mesh.transformed(X_BP), CLEAR_OF_PART_M),))


def free_move(welder: Welder, q_a: Array, q_b: Array, X_BP: RigidTransform | None) -> bool:
    """Whether a straight move in joint space (6,) rad between two seams of a known part is free.

    It is checked against part, surroundings, table and the arm itself.
    """
    arm, bodies = welder.arm, arm_bodies(welder.arm, welder.tool.capsules())
    if X_BP is None or any(
        s.touched_on_path(arm, bodies, q_a, q_b) for s in (_part(welder, X_BP), welder.surroundings)
    ):
        return False
    lowest, gap = path_clearance(arm, bodies, q_a, q_b)
    least = min(0.0, self_distance(bodies, link_frames(arm, welder.q_near)))
    return bool(gap >= least and lowest > welder.table_z_m)


def _lifted(arm: ArmModel, seam: SeamCurve, X_BT: RigidTransform, height_m: float, s: float = 0.0) -> RigidTransform:
    """The tool's pose at X_BT raised out of the joint at arc length s m.

    Up on a level face, else along the bisector.
    """
    up = seam.frame(s).up
    return RigidTransform(
        X_BT.rotation(), X_BT.translation() + height_m * (arm.up if float(up @ arm.up) > _LEVEL else up)
    )


def arm_waypoints(
    arm: ArmModel, tool: WeldingTool, seam: SeamCurve, config: ServoConfig, q_near: Array, clearance_m: float
) -> tuple[Array, Array, Array]:
    """Joint positions (6,) rad at the touch start, above it, and above the far end.

    Raises:
        SeamOutOfReach: where no inverse kinematics solution exists.
    """
    X_BT, end = touch_start_pose(seam, config), seam.length
    X_BE = RigidTransform(X_BT.rotation(), seam.frame(end).position)
    goals = {
        "above its start": _lifted(arm, seam, X_BT, clearance_m),
        "at its start": X_BT,
        "above its end": _lifted(arm, seam, X_BE, clearance_m + 0.05, end),
    }
    solutions, q = [], q_near
    for where, pose in goals.items():
        X_BF = pose @ tool.X_FT.inverse()
        found = nearest_solution(arm, X_BF, q)
        if found is None:
            far = float(np.linalg.norm(X_BF.translation())) > 0.5 * (abs(arm.dh.a2) + abs(arm.dh.a3))
            joint, to = ("elbow", "towards") if far else ("shoulder pan", "away from")
            problem = f"The arm cannot reach the seam {where}, with the {joint} at its end"
            raise SeamOutOfReach(problem, f"move the workpiece {to} the robot")
        solutions.append(found)
        q = found
    q_above, q_start, q_retract = solutions
    return q_start, q_above, q_retract
