"""Error budgets of the weld study, tag, robot, wall and plan, and what differs from what the servo believes."""

import math
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
from pydrake.math import RotationMatrix
from scipy.ndimage import gaussian_filter1d

from tests.worlds.weld.groove import DRAWN, Wedge
from tests.worlds.weld.seams import TrueSeam
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve

Range = tuple[float, float]
_NONE = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Ranges (low, high) from which a seed draws one world, evenly; SI units. The servo gets none of it.

    Attributes:
        image_bias_s, pose_bias_s: how late a picture or a pose is stamped; image_jitter_s, pose_jitter_s: one sigma of
            each single stamp.
        left_wall_rad, right_wall_rad: how much farther each wall of the groove is open.
        wear_m: lost of the tip's radius; seat_m: how much higher the tip sits than wedge and radius say.
        lag_share: the robot's lag over the one that the servo looks ahead by; None leaves the budget's.
    """

    image_bias_s: Range = _NONE
    image_jitter_s: Range = _NONE
    pose_bias_s: Range = _NONE
    pose_jitter_s: Range = _NONE
    left_wall_rad: Range = _NONE
    right_wall_rad: Range = _NONE
    wear_m: Range = _NONE
    seat_m: Range = _NONE
    lag_share: Range | None = None


NOTHING_UNKNOWN = Unknowns()


@dataclass(frozen=True, kw_only=True)
class WeldUnknowns:
    """One draw: as in Unknowns; `lag_share` NaN where the budget's lag holds."""

    image_bias_s: float = 0.0
    image_jitter_s: float = 0.0
    pose_bias_s: float = 0.0
    pose_jitter_s: float = 0.0
    left_wall_rad: float = 0.0
    right_wall_rad: float = 0.0
    wear_m: float = 0.0
    seat_m: float = 0.0
    lag_share: float = math.nan

    @property
    def wedge(self) -> Wedge:
        """The groove's section as it really is, with the tip as it really is."""
        return Wedge(
            DRAWN.radius_m - self.wear_m,
            DRAWN.half_angle_rad + 0.5 * (self.left_wall_rad + self.right_wall_rad),
            DRAWN.depth_m,
            0.5 * (self.left_wall_rad - self.right_wall_rad),
        )

    def lag_s(self, budget_s: float, believed_s: float) -> float:
        """Return the robot's lag: the budget's, or a share of the servo's own."""
        return budget_s if math.isnan(self.lag_share) else self.lag_share * believed_s


def draw_world(unknowns: Unknowns, seed: int) -> WeldUnknowns:
    """Return the world of a seed, from a generator of its own: the other errors of a run do not change with it."""
    rng = np.random.default_rng((seed, 1))
    ranges = zip((field.name for field in fields(WeldUnknowns)), astuple(unknowns), strict=True)
    return WeldUnknowns(**{name: math.nan if r is None else float(rng.uniform(*r)) for name, r in ranges})


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Errors of one world, SI units.

    Attributes:
        name: as in the tables.
        tag_sigma_m, tag_gain, tag_yaw_rad, tag_bias_m: of the deflection that the finger camera measures; latency_s:
            its age.
        lag_s: time constant of the robot's velocity.
        friction: between tip and walls; roughness_m: of the wall, one sigma; roughness_length_m: its correlation.
        plan_shift_m, plan_angle_rad, plan_height_m: how the plan is displaced as a whole; plan_warp_m: largest bend of
            it; plan_smoothing_m: sigma of the vision's smoothing; plan_noise_m: of each of its points, a millimetre
            apart.
        unknown: what the servo believes wrongly.
    """

    name: str
    tag_sigma_m: float = 0.05e-3
    tag_gain: float = 1.03
    tag_yaw_rad: float = math.radians(0.5)
    tag_bias_m: float = 0.0
    latency_s: float = 0.040
    lag_s: float = 0.020
    friction: float = 0.2
    roughness_m: float = 0.0
    roughness_length_m: float = 2.0e-3
    plan_shift_m: float = 2.0e-3
    plan_angle_rad: float = math.radians(0.5)
    plan_height_m: float = 0.5e-3
    plan_warp_m: float = 0.5e-3
    plan_smoothing_m: float = 3.0e-3
    plan_noise_m: float = 0.15e-3
    unknown: Unknowns = NOTHING_UNKNOWN


NOMINAL = Budget(name="nominal")
HARD = Budget(
    name="hard",
    tag_sigma_m=0.10e-3,
    tag_gain=1.08,
    latency_s=0.060,
    lag_s=0.050,
    friction=0.35,
    roughness_m=0.1e-3,
    plan_shift_m=3.0e-3,
    plan_height_m=1.0e-3,
    plan_warp_m=1.0e-3,
    plan_noise_m=0.30e-3,
)
PERFECT = Budget(
    name="perfect",
    tag_sigma_m=0.0,
    tag_gain=1.0,
    tag_yaw_rad=0.0,
    latency_s=0.0,
    lag_s=0.0,
    friction=0.0,
    plan_shift_m=0.0,
    plan_angle_rad=0.0,
    plan_height_m=0.0,
    plan_warp_m=0.0,
    plan_smoothing_m=0.0,
    plan_noise_m=0.0,
)
KINEMATIC = replace(PERFECT, name="kinematic", lag_s=0.020, tag_sigma_m=0.02e-3)

# docs/weld_law.md, section 8, says where each size comes from.
_WALL = math.radians(0.75)
_STAMPS = Unknowns(
    image_bias_s=(-0.010, 0.010), image_jitter_s=(0.002, 0.002), pose_bias_s=(0.0, 0.008), pose_jitter_s=(0.002, 0.002)
)
IMPERFECT = replace(
    NOMINAL,
    name="imperfect",
    unknown=replace(
        _STAMPS,
        left_wall_rad=(-_WALL, _WALL),
        right_wall_rad=(-_WALL, _WALL),
        wear_m=(0.0, 0.1e-3),
        seat_m=(-0.1e-3, 0.1e-3),
        lag_share=(0.5, 2.0),
    ),
)
SINGLE = tuple(
    replace(NOMINAL, name=name, unknown=unknown)
    for name, unknown in (
        ("wedge_open", Unknowns(left_wall_rad=(_WALL, _WALL), right_wall_rad=(_WALL, _WALL))),
        ("wedge_side", Unknowns(left_wall_rad=(_WALL, _WALL), right_wall_rad=(-_WALL, -_WALL))),
        ("wear", Unknowns(wear_m=(0.1e-3, 0.1e-3))),
        ("seat", Unknowns(seat_m=(0.1e-3, 0.1e-3))),
        ("lag_double", Unknowns(lag_share=(2.0, 2.0))),
    )
)
BUDGETS = {b.name: b for b in (NOMINAL, IMPERFECT, *SINGLE, HARD, KINEMATIC, PERFECT)}


def planned_seam(seam: TrueSeam, budget: Budget, rng: np.random.Generator) -> SeamCurve:
    """What vision makes of the root line: smoothed, warped, noisy, displaced as a whole, and splined by the planner."""
    true = SeamCurve.from_points(seam.points, seam.up)
    if budget.plan_smoothing_m == 0.0 and budget.plan_noise_m == 0.0 and budget.plan_warp_m == 0.0:
        return true
    n = round(true.length / 1e-3)
    s = np.linspace(0.0, true.length, n + 1)
    spacing = s[1]
    # Beyond its ends the seam goes straight on, so that the smoothing does not pull them in.
    pad = np.arange(1, 41) * spacing
    wide = true.position(np.concatenate([-pad[::-1], s, true.length + pad]))
    p = (
        gaussian_filter1d(wide, budget.plan_smoothing_m / spacing, axis=0)[40:-40]
        if budget.plan_smoothing_m
        else true.position(s)
    )
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    bend = sum(np.sin(2.0 * np.pi * s * k / s[-1] + phase[k - 1]) / k for k in (1, 2, 3))
    bend = budget.plan_warp_m * bend / max(1e-12, float(np.max(np.abs(bend))))
    noise = rng.normal(0.0, 1.0, (len(s), 2)) * budget.plan_noise_m
    p = p + (bend + noise[:, 0])[:, None] * true.normal(s) + noise[:, 1:] * true.up(s)
    angle = budget.plan_angle_rad * rng.choice([-1.0, 1.0])
    heading = rng.uniform(0.0, 2.0 * np.pi)
    shift = budget.plan_shift_m * np.array([math.cos(heading), math.sin(heading), 0.0])
    shift[2] = budget.plan_height_m * rng.choice([-1.0, 1.0])
    R = RotationMatrix.MakeZRotation(angle).matrix()
    middle = p[len(p) // 2]
    # The planner's spline irons out what is shorter than 3 mm, as SeamCurve.from_points describes.
    return SeamCurve.from_points((p - middle) @ R.T + middle + shift, true.up(s) @ R.T, smoothing=(3e-3) ** 4 / spacing)


def roughness(length: float, budget: Budget, rng: np.random.Generator, spacing: float = 0.25e-3) -> Array:
    """Sideways roughness (N,) m of the wall every `spacing` m.

    Gaussian, of the budget's sigma and correlation length.
    """
    n = max(4, int(length / spacing) + 2)
    if budget.roughness_m == 0.0:
        return np.zeros(n)
    # White noise under a Gaussian of sigma L/2 has the correlation exp(-(x/L)^2).
    raw = gaussian_filter1d(rng.normal(size=n), 0.5 * budget.roughness_length_m / spacing, mode="wrap")
    return np.asarray(budget.roughness_m * raw / max(1e-12, float(raw.std())))
