"""Edge with a break, sphere and planes of one mounting: whether the joint region is right, and disagreement is named.

Everything is made by rays: each sample of a profile is where a ray of the sensor first meets the plate (faces and an
arc between them), the sphere or a plane. The arm has a wrong table of links; its last row is part of the mounting.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from tests.figures.harness import Missed, Run, figure
from tests.worlds.profiler import CLEAN, SphereWorld, looking_down
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import difference, pose
from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.combined.planes import plane_scans
from weldcal.calibration.profiler.combined.scans import FeatureScans
from weldcal.calibration.profiler.combined.solve import JointEstimate, solve_joint
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.tools.commands.profiler.edge import EdgeShown, calibrate_edge, edge_part, edge_shown
from weldcal.tools.commands.profiler.files import Measurements
from weldcal.tools.commands.profiler.joint import planes_shown
from weldcal.tools.commands.profiler.result import Sigmas
from weldcal.tools.commands.profiler.sphere import calibrate_sphere, sphere_part

X_SAMPLES = np.arange(-25e-3, 25e-3, 0.1e-3)
RADIUS_M = 20e-3
DISTANCE_M = 0.2  # of the features from the sensor
FLOOR_M = 15e-3  # of the plate's thickness
NOISE_M = 0.03e-3
REPEATED_M = 0.03e-3  # per axis: a repeatability of 0.05 mm
SCANS = (24, 16, 24)  # of edge, sphere and planes
TILT_DEG, YAW_DEG = 25.0, 50.0
ARM_M, BREAK_M, FAULT_SIGMAS = (0.05e-3, 0.3e-3), (0.0, 1e-3), (5.0, 10.0)
FAULTS = ("edge", "sphere", "planes", "radius")
SIGMAS = Sigmas(stated=False)
ORIGIN, SENSOR = np.array([0.0, DISTANCE_M]), np.diag(np.full(3, SphereSigmas().affine ** 2))


Views = tuple[Floats, Floats, Floats, Callable[[Floats, float], Floats]]
"""Orientations R_BS (n, 3, 3), where the target lies in S (n, 3), targets (n, 3) m, and z (m,) of a profile."""


@dataclass(frozen=True, eq=False)
class Scans:
    """Poses as the controller states them, and raw profiles (m, 2) m."""

    poses: FlangePoses
    profiles: tuple[Floats, ...]

    def with_tool(self, offset: Floats) -> "Scans":
        """Return the same with another tool active: the stated poses are off by a constant in the flange."""
        return Scans(
            FlangePoses(self.poses.rotation, self.poses.translation + self.poses.rotation @ offset), self.profiles
        )

    @property
    def file(self) -> Measurements:
        """The same as a file holds them."""
        arrays = {"rotation": self.poses.rotation, "translation": self.poses.translation}
        return Measurements(arrays=arrays, profiles=self.profiles, digest="")


@dataclass(frozen=True, eq=False, kw_only=True)
class Made:
    """The scans of a set, X_FS (4, 4), the radius of the edge's break and the sphere's stated one, m."""

    edge: Scans
    sphere: Scans
    planes: tuple[Scans, ...]
    X_FS: Floats
    break_m: float
    radius_m: float = RADIUS_M


def made_set(seed: int) -> Made:
    """Return a set of a seed."""
    rng = np.random.default_rng([seed, 62])
    w = SphereWorld.made(seed, CLEAN)
    plan = [_edge_views(w, rng), _sphere_views(w, rng), *_plane_views(w, rng)]
    joints = [w.joints(*w.viewing(R_BS, p_S, at)) for R_BS, p_S, at, _ in plan]
    arm_m, break_m = rng.uniform(*ARM_M), rng.uniform(*BREAK_M)
    real = _wrong_arm(w.cell.arm, np.vstack(joints), arm_m, rng)
    scans = []
    for q, (_, _, _, cut) in zip(joints, plan, strict=True):
        X, profiles = real.frames(q)[:, 6], []
        for X_BF in X:
            X_BS = X_BF @ pose(w.rotation, w.translation)
            X_BS[:3, 3] += REPEATED_M * rng.standard_normal(3)
            z = cut(X_BS, break_m)
            z += NOISE_M * rng.standard_normal(len(z))
            profiles.append(np.column_stack([X_SAMPLES, z]))
        believed = w.cell.arm.frames(q)[:, 6]
        scans.append(Scans(FlangePoses(believed[:, :3, :3], believed[:, :3, 3]), tuple(profiles)))
    return Made(
        edge=scans[0], sphere=scans[1], planes=tuple(scans[2:]), X_FS=pose(w.rotation, w.translation), break_m=break_m
    )


def _wrong_arm(arm: DhArm, q: Floats, size_m: float, rng: np.random.Generator) -> DhArm:
    """Return the arm with a wrong table, by which the flange is off by so much (rms) in these joints (n, 6)."""
    off = np.vstack([rng.standard_normal((5, 4)), np.zeros(4)])
    scale = 1e-6  # m and rad: links of about a metre
    for _ in range(3):
        d = DhArm(arm.rows + scale * off).frames(q)[:, 6, :3, 3] - arm.frames(q)[:, 6, :3, 3]
        scale *= size_m / float(np.sqrt((d**2).sum(axis=1).mean()))
    return DhArm(arm.rows + scale * off)


def _rays(X_BS: Floats) -> tuple[Floats, Floats]:
    """Origins (n, 3) of the sensor's rays in B, and their direction (3,)."""
    return np.outer(X_SAMPLES, X_BS[:3, 0]) + X_BS[:3, 3], X_BS[:3, 2]


def _edge_views(w: SphereWorld, rng: np.random.Generator) -> Views:
    """A plate's long edge: the sensor looks over the near face, the side face is hidden."""
    n, centre = SCANS[0], w.cell.center + rng.uniform(-0.15, 0.15, 3) * [1.0, 1.0, 0.3]
    turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [180.0, 8.0, 8.0], degrees=True).as_matrix()
    inward, along, up = turn.T
    base = np.column_stack([inward, -along, -up])  # x over the near face, z down
    angles = np.column_stack(
        [rng.uniform(-YAW_DEG, YAW_DEG, n), rng.uniform(-32.0, -2.0, n), rng.uniform(-TILT_DEG, TILT_DEG, n)]
    )
    R_BS = base @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    p_S = np.column_stack([rng.uniform(-15e-3, 8e-3, n), np.zeros(n), DISTANCE_M + rng.uniform(-20e-3, 20e-3, n)])
    at = centre + rng.uniform(-40e-3, 40e-3, (n, 1)) * along

    def cut(X_BS: Floats, r: float) -> Floats:
        o, d = _rays(X_BS)
        u, h, v, k = (o - centre) @ inward, (o - centre) @ up, d @ inward, d @ up
        top, beside, below = -h / k, -u / v, (-FLOOR_M - h) / k  # distances to the faces and the floor
        fall = h + beside * k
        nearest = np.where((top > 0.0) & (u + top * v >= r), top, np.inf)
        nearest = np.where((beside > 0.0) & (fall <= -r) & (fall >= -FLOOR_M), np.minimum(nearest, beside), nearest)
        nearest = np.where((below > 0.0) & (u + below * v <= 0.0), np.minimum(nearest, below), nearest)
        if r > 0.0:  # the arc about (r, -r), where it is outside of both faces
            a, b, c = v**2 + k**2, (u - r) * v + (h + r) * k, (u - r) ** 2 + (h + r) ** 2 - r**2
            with np.errstate(invalid="ignore"):
                s = (-b - np.sqrt(b**2 - a * c)) / a
            good = (u + s * v < r) & (h + s * k > -r)
            nearest = np.where(good, np.minimum(nearest, s), nearest)
        return np.where(np.isfinite(nearest), nearest, np.nan)

    return R_BS, p_S, at, cut


def _sphere_views(w: SphereWorld, rng: np.random.Generator) -> Views:
    """A sphere, cut up to 0.7 radii beside its centre; flat incidence returns nothing."""
    n, centre = SCANS[1], w.cell.center + rng.uniform(-0.15, 0.15, 3) * [1.0, 1.0, 0.3]
    R_BS = looking_down(rng, n, TILT_DEG, YAW_DEG)
    p_S = np.column_stack(
        [rng.uniform(-6e-3, 6e-3, n), rng.uniform(-0.7, 0.7, n) * RADIUS_M, DISTANCE_M + rng.uniform(-20e-3, 20e-3, n)]
    )

    def cut(X_BS: Floats, r: float) -> Floats:
        o, d = _rays(X_BS)
        b, c = (o - centre) @ d, ((o - centre) ** 2).sum(axis=1) - RADIUS_M**2
        with np.errstate(invalid="ignore"):
            s = -b - np.sqrt(b**2 - c)
            n = (o + s[:, None] * d - centre) / RADIUS_M
            return np.where(-n @ d > np.cos(np.radians(65.0)), s, np.nan)

    return R_BS, p_S, np.tile(centre, (n, 1)), cut


def _plane_views(w: SphereWorld, rng: np.random.Generator) -> Iterator[Views]:
    """Three planes: one level, two tilted by 30 deg about two axes."""
    n = SCANS[2] // 3
    for angles in ([0.0, 0.0], [30.0, 0.0], [0.0, -30.0]):
        centre = w.cell.center + rng.uniform(-0.15, 0.15, 3) * [1.0, 1.0, 0.3]
        turn = Rotation.from_euler("yx", np.array(angles) + rng.uniform(-5, 5, 2), degrees=True).as_matrix()
        normal = turn[:, 2]
        R_BS = turn @ looking_down(rng, n, TILT_DEG, YAW_DEG)
        p_S = np.column_stack([np.zeros((n, 2)), DISTANCE_M + rng.uniform(-20e-3, 20e-3, n)])
        at = centre + rng.uniform(-30e-3, 30e-3, (n, 2)) @ turn[:, :2].T

        def cut(X_BS: Floats, r: float, centre: Floats = centre, normal: Floats = normal) -> Floats:
            o, d = _rays(X_BS)
            return -((o - centre) @ normal) / (d @ normal)

        yield R_BS, p_S, at, cut


@lru_cache(maxsize=4)
def edge_of(scans: Scans) -> EdgeShown:
    """Return the edge as the command finds it in the profiles."""
    return edge_shown(scans.file, SIGMAS, "bar", "left", "away")


@lru_cache(maxsize=4)
def sphere_of(scans: Scans, radius_m: float) -> tuple[SphereData, SphereEstimate]:
    """Return the sphere's arcs and the sphere's own estimate."""
    arcs = tuple(p[np.isfinite(p).all(axis=1)] for p in scans.profiles)
    data = SphereData(poses=scans.poses, profiles=arcs, radius_m=radius_m)
    return data, sphere_joint(data, "affine")


def parts_of(made: Made) -> list[FeatureScans]:
    """Return the scans of a set as the command reduces them."""
    shown, sphere = edge_of(made.edge), sphere_of(made.sphere, made.radius_m)
    assert shown.fit is not None
    ball = sphere_part(*sphere, ORIGIN)
    return [edge_part(shown, *shown.fit, ORIGIN), ball, planes_of(made, ball.X_FS)]


def planes_of(made: Made, X_FS: Floats | None = None) -> FeatureScans:
    """Return the scans of the planes, about X_FS or without any start."""
    planes = planes_shown([one.file for one in made.planes])
    return plane_scans(planes.poses, planes.profiles, planes.of, ORIGIN, X_FS)


def square_of(e: JointEstimate | ProfilerRecord, X_FS: Floats) -> float:
    """Return the squared Mahalanobis distance of the truth."""
    assert e.covariance is not None
    d = difference(pose(e.rotation, e.translation), X_FS)
    return float(d @ np.linalg.solve(e.covariance, d))


def faulty(made: Made, good: JointEstimate, part: str, rng: np.random.Generator) -> tuple[Made, tuple[str, str]]:
    """Return a set with a wrong tool in a part, or a wrong sphere's radius, of 5 to 10 sigmas; and the right name."""
    name = "radius" if part == "radius" else "shift"
    cause = next(c for c in good.tested if c.name == name and (name == "radius" or c.part == part))
    u = rng.standard_normal(len(cause.value))
    off = rng.uniform(*FAULT_SIGMAS) * np.linalg.cholesky(cause.covariance) @ u / np.linalg.norm(u)
    right = (cause.name, cause.part)
    if name == "radius":
        return replace(made, radius_m=made.radius_m + float(off[0])), right
    if part == "planes":
        return replace(made, planes=tuple(one.with_tool(off) for one in made.planes)), right
    return replace(made, edge=made.edge.with_tool(off)) if part == "edge" else replace(
        made, sphere=made.sphere.with_tool(off)
    ), right


@figure("profiler-joint", "edge with a break, sphere and planes of one mounting: joint region, disagreements named")
def profiler_joint(run: Run) -> None:
    """Make sets by rays with a wrong arm, and solve them as the commands do. 3 s a set."""
    squares: dict[str, list[float]] = {who: [] for who in ("edge", "sphere", "planes", "together")}
    named, right, of = (dict.fromkeys(FAULTS, 0) for _ in range(3))
    breaks, wrong = list[float](), 0
    seeds = run.seeds(3, 200)
    for n, seed in enumerate(seeds):
        run.progress(f"set {seed}", n / len(seeds))
        made, rng = made_set(seed), np.random.default_rng([seed, 63])
        parts = parts_of(made)
        e = solve_joint(parts, SENSOR)
        edge, _ = calibrate_edge(edge_of(made.edge), SIGMAS)
        sphere, _ = calibrate_sphere(sphere_of(made.sphere, made.radius_m)[0], "", Sigmas(), model="affine")
        found: list[JointEstimate | ProfilerRecord] = [edge, sphere, solve_joint([planes_of(made)], SENSOR), e]
        for who, one in zip(squares, found, strict=True):
            squares[who].append(square_of(one, made.X_FS))
        assert e.edge_radius_m is not None
        breaks.append((e.edge_radius_m[0] - made.break_m) / e.edge_radius_m[1])
        wrong += bool(e.causes)
        fault = FAULTS[n % len(FAULTS)]
        bad, cause = faulty(made, e, fault, rng)
        causes = solve_joint(parts_of(bad), SENSOR).causes
        of[fault] += 1
        named[fault] += bool(causes)
        right[fault] += bool(causes) and cause in [(c.name, c.part) for c in causes]
    limit, total = chi2_quantile(0.95, 6.0), len(seeds)
    held = {who: sum(v < limit for v in each) for who, each in squares.items()}
    rows = [
        (f"{who}: truth in the 95 % region", f"{held[who]} of {total}", f"mean square {np.mean(each):.1f}, 6 expected")
        for who, each in squares.items()
    ]
    spread = float(np.sqrt(np.mean(np.square(breaks))))
    rows.append(("radius of the break, error over its sigma", f"{spread:.2f}", "1 expected"))
    rows.append(("parts agree: falsely named", f"{wrong} of {total}", "1 of 100"))
    for fault in FAULTS:
        what = "sphere's radius" if fault == "radius" else f"tool of the {fault}"
        rows.append((f"{what} wrong: named", f"{named[fault]} of {of[fault]}", f"the right cause in {right[fault]}"))
    every = sum(named[fault] for fault in FAULTS)
    rows.append(("all faults: named", f"{every} of {total}", "95 of 100"))
    run.table("", ("what", "reached", "for comparison"), rows)
    share = held["together"] / total
    if run.full and not (0.90 <= share <= 0.98 and wrong <= 0.01 * total and every >= 0.95 * total):
        raise Missed("Regions or names of the joint solution are not what they must be.")
