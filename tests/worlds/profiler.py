"""Simulated worlds under a profiler: sphere, S-shaped V-groove, frustum; wrong arm, distorted sensor, bent torch.

Everything random follows from the seed. Two cells: the one that the fixed files were made in, from which files of other
seeds come, and a UR10e with another scanner pose in every world. The sag has the form that the calibration's model also
has.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.arm_errors import OFFSET_JOINTS, DhArm
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.arms.dh import dh_parameters
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, o3d
from weldcal.models.profilers import ProfilerPreset

RADIUS_M = 0.020
SAMPLES = 120
REACH_RAD = np.radians(70.0)  # of the arc that is seen, from its top
ABOUT = np.array([0.0, 0.2])  # the middle of the sensor's field
DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # a scanner that looks down


@dataclass(frozen=True, kw_only=True)
class WorldErrors:
    """One sigma of each cause (m, rad).

    Lengths, joints and twists of the arm, sag per metre of lever, sensor, tip, repeatability.
    """

    length_m: float = 0.125e-3
    angle_rad: float = np.radians(0.0125)
    twist_rad: float = np.radians(0.0125)
    sag_rad_m: float = np.radians(0.02)
    affine: float = 0.008
    tip_m: float = 3.5e-3
    repeatability_m: float = 0.04e-3
    noise_m: float = 0.05e-3


CLEAN = WorldErrors(length_m=0.0, angle_rad=0.0, twist_rad=0.0, sag_rad_m=0.0, affine=0.0, tip_m=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerCell:
    """Hold the pose of a world's arm.

    Its table, joints at which the tool points downwards, the sphere's centre (3,) m, and where the groove's and the
    frustum's frames lie, the groove turned about z.
    """

    arm: DhArm
    home: Floats
    center: Floats
    groove: Floats
    groove_turn_deg: float
    boss: Floats
    boss_yaw_deg: float


def files_cell() -> ProfilerCell:
    """Of the fixed files: an arm of 1.4 m reach with a torch of 342 mm."""
    rows = np.array(
        [[180, -90, 400, 0], [600, 0, 0, -90], [120, -90, 0, 0], [0, 90, 620, 0], [0, -90, 0, 0], [0, 0, 115, 0]], float
    ) * [1e-3, np.radians(1.0), 1e-3, np.radians(1.0)]
    center = np.array([0.93, 0.06, 0.26])
    return ProfilerCell(
        arm=DhArm(rows),
        home=np.array([0.0, 0.35, 0.25, 0.0, 0.95, 0.0]),
        center=center,
        groove=np.array([0.78, 0.06, 0.23]),
        groove_turn_deg=0.0,
        boss=center - [0.0, 0.0, 0.03],
        boss_yaw_deg=45.0,
    )


def ur10e_cell() -> ProfilerCell:
    """Return a UR10e."""
    center = np.array([-0.75, 0.12, 0.18])
    return ProfilerCell(
        arm=DhArm(dh_parameters(load_arm("ur10e"))),
        home=np.radians([0.0, -110.0, 120.0, -100.0, -90.0, 0.0]),
        center=center,
        groove=np.array([-0.75, -0.03, 0.15]),
        groove_turn_deg=90.0,
        boss=center - [0.0, 0.0, 0.03],
        boss_yaw_deg=57.0,
    )


@dataclass(frozen=True, eq=False)
class SphereTests:
    """Points that the sensor saw and the tip then touched: joints (n, 6) at both, points (n, 2) m, which of three."""

    q_view: Floats
    seen: Floats
    q_touch: Floats
    point: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereWorld:
    """One robot with one profiler and one torch: `cell.arm` is what is believed, the rest is how it is."""

    cell: ProfilerCell
    real: DhArm
    sag: Floats
    rotation: Floats
    translation: Floats
    tip: Floats
    tip_believed: Floats
    sensor: Floats
    offset: Floats
    bend: Floats
    errors: WorldErrors

    @staticmethod
    def like_the_files(seed: int) -> SphereWorld:
        """Of another seed than the fixed files, and else as they were made.

        Only the arm's table, the tip and signs vary.
        """
        e = WorldErrors(angle_rad=np.radians(0.015), twist_rad=np.radians(0.01))
        rng = np.random.default_rng([seed, 75])
        cell = files_cell()
        tip = np.array([-0.012, 0.004, 0.342])
        bent = np.array([[0.008, 0.012], [0.004, 0.014]]) * rng.choice([-1, 1], (2, 2))
        return SphereWorld(
            cell=cell,
            real=_wrong(cell.arm, e, rng),
            sag=0.3 * np.array([18e-6 * 30.5, 27e-6 * 19.0]) * 9.81,  # rad/Nm of joints 2 and 3 times kg beyond them
            rotation=Rotation.from_euler("ZYX", [88.0, -14.0, 176.0], degrees=True).as_matrix(),
            translation=np.array([0.035, -0.068, 0.165]),
            tip=tip,
            tip_believed=tip + 3.54e-3 * rng.standard_normal(3),
            sensor=np.eye(2) + bent,
            offset=np.array([0.5e-3, -0.8e-3]),
            bend=np.array([0.02, -0.03]),
            errors=e,
        )

    @staticmethod
    def made(seed: int, errors: WorldErrors | None = None) -> SphereWorld:
        """Return a UR10e's world of a seed, the scanner somewhere else in each."""
        e = errors or WorldErrors()
        rng = np.random.default_rng([seed, 71])
        cell = ur10e_cell()
        real = _wrong(cell.arm, e, rng)
        R = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [60.0, 15.0, 15.0], degrees=True).as_matrix()
        t = np.array([0.035, -0.068, -0.02]) + rng.uniform(-0.02, 0.02, 3)
        tip = np.array([-0.012, 0.004, 0.19])
        sensor = np.eye(2) + e.affine * rng.uniform(-1.5, 1.5, (2, 2))
        return SphereWorld(
            cell=cell,
            real=real,
            sag=e.sag_rad_m * np.abs(rng.standard_normal(2)),
            rotation=R,
            translation=t,
            tip=tip,
            tip_believed=tip + e.tip_m * rng.standard_normal(3),
            sensor=sensor,
            offset=e.affine * np.array([0.06, -0.1]),
            bend=np.zeros(2),
            errors=e,
        )

    def poses(self, q: Floats) -> FlangePoses:
        """Where the flange really is."""
        return self.real.poses(q, np.zeros(len(OFFSET_JOINTS)), self.sag, self.real.loads(q))

    def believed(self, q: Floats) -> FlangePoses:
        """Where the controller says that it is."""
        return self.cell.arm.poses(q, np.zeros(len(OFFSET_JOINTS)), np.zeros(2), self.cell.arm.loads(q))

    def repeated(self, q: Floats, rng: np.random.Generator) -> FlangePoses:
        """Where the flange is this time."""
        X = self.poses(q)
        return FlangePoses(X.rotation, X.translation + self.errors.repeatability_m * rng.standard_normal((len(q), 3)))

    def measured(self, p: Floats, rng: np.random.Generator) -> Floats:
        """Profile points (..., 2) as the sensor reports them."""
        u = p - ABOUT
        bent = u @ self.sensor.T + ABOUT + self.offset + self.bend * u**2
        return np.asarray(bent + self.errors.noise_m * rng.standard_normal(p.shape))

    def joints(self, R_BF: Floats, p_BF: Floats) -> Floats:
        """Joints (n, 6) that the controller finds for flange poses, by Newton's method from the cell's home."""
        q = np.tile(self.cell.home, (len(p_BF), 1))
        for _ in range(60):
            X = self.cell.arm.frames(q)
            dp = p_BF - X[:, 6, :3, 3]
            turn = Rotation.from_matrix(R_BF @ np.swapaxes(X[:, 6, :3, :3], 1, 2)).as_rotvec()
            axes = np.swapaxes(X[:, :6, :3, 2], 1, 2)
            arms = np.cross(X[:, :6, :3, 2], X[:, 6:7, :3, 3] - X[:, :6, :3, 3])
            J = np.concatenate([np.swapaxes(arms, 1, 2), axes], axis=1)
            step = np.linalg.solve(J, np.concatenate([dp, turn], axis=1)[:, :, None])[:, :, 0]
            largest = np.abs(step).max(axis=1, keepdims=True)
            q = q + step * np.minimum(1.0, 0.3 / np.maximum(largest, 1e-12))
            if largest.max() < 1e-12:
                break
        return np.asarray(q)

    def viewing(self, R_BS: Floats, p_S: Floats, target: Floats) -> tuple[Floats, Floats]:
        """Flange poses from which targets (n, 3) lie at p_S (n, 3) of the scanner, which has the orientations R_BS."""
        R = R_BS @ self.rotation.T
        return R, target - np.einsum("nij,nj->ni", R, p_S @ self.rotation.T + self.translation)

    def in_scanner(self, X: FlangePoses, points: Floats) -> Floats:
        """Points (n, 3) of B in the scanner's frame, for real poses of the flange."""
        p_F = np.einsum("nji,nj->ni", X.rotation, points - X.translation)
        return np.asarray((p_F - self.translation) @ self.rotation)

    def touching(self, targets: Floats, R_BF: Floats) -> Floats:
        """Joints (n, 6) at which the real tip is on each target: the robot is jogged until it is."""
        p = targets - np.einsum("nij,j->ni", R_BF, self.tip)
        q = self.joints(R_BF, p)
        for _ in range(4):
            X = self.poses(q)
            p = p + targets - (X.rotation @ self.tip + X.translation)
            q = self.joints(R_BF, p)
        return q


def _wrong(arm: DhArm, e: WorldErrors, rng: np.random.Generator) -> DhArm:
    """Return the arm as it was built."""
    return DhArm(arm.rows + rng.standard_normal((6, 4)) * [e.length_m, e.twist_rad, e.length_m, e.angle_rad])


def looking_down(rng: np.random.Generator, n: int, tilt_deg: float, yaw_deg: float) -> Floats:
    """Orientations (n, 3, 3) of a scanner that looks down, tilted and turned at random."""
    turn = rng.uniform(-1.0, 1.0, (n, 3)) * [yaw_deg, tilt_deg, tilt_deg]
    return np.asarray(DOWN @ Rotation.from_euler("ZYX", turn, degrees=True).as_matrix())


def arcs(world: SphereWorld, q: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Profiles (n, 120, 2) m of the sphere at these joints, and on which side (n,) of the scan plane its centre is."""
    c = world.in_scanner(world.repeated(q, rng), np.tile(world.cell.center, (len(q), 1)))
    r = np.sqrt(RADIUS_M**2 - c[:, 1] ** 2)
    a = np.linspace(-REACH_RAD, REACH_RAD, SAMPLES)
    p = np.stack([c[:, :1] + r[:, None] * np.sin(a), c[:, 2:] - r[:, None] * np.cos(a)], axis=2)
    return world.measured(p, rng), np.sign(c[:, 1])


@dataclass(frozen=True, eq=False)
class SphereTrial:
    """All that one calibration by a sphere and touches is given, and what it is tested with."""

    data: SphereData
    sign: Floats
    translated: NDArray[np.bool_]
    tests: SphereTests | None


def sphere_trial(
    world: SphereWorld, seed: int, *, translations: int = 10, free: int = 10, touches: int = 60, views: int = 10
) -> SphereTrial:
    """Make ten translations, ten free poses, sixty touches and three points measured and touched in ten views.

    The free poses tilt by 12 deg and turn by 10 deg.
    """
    rng = np.random.default_rng([seed, 72])
    n = translations + free
    R_BS = np.concatenate(
        [np.repeat(looking_down(rng, 1, 8.0, 8.0), translations, 0), looking_down(rng, free, 12.0, 10.0)]
    )
    p_S = np.column_stack(
        [
            np.concatenate([rng.uniform(-0.016, 0.016, translations), rng.uniform(-0.012, 0.012, free)]),
            np.concatenate(
                [rng.uniform(0.0055, 0.0165, translations), rng.uniform(0.006, 0.014, free) * rng.choice([-1, 1], free)]
            ),
            np.concatenate([rng.uniform(0.198, 0.226, translations), rng.uniform(0.195, 0.230, free)]),
        ]
    )
    q = world.joints(*world.viewing(R_BS, p_S, np.tile(world.cell.center, (n, 1))))
    profiles, sign = arcs(world, q, rng)
    out = rng.standard_normal((touches, 3))
    out[:, 2] = np.abs(out[:, 2])
    felt = world.cell.center + RADIUS_M * out / np.linalg.norm(out, axis=1, keepdims=True)
    felt += world.errors.repeatability_m * rng.standard_normal(felt.shape)
    touch_q = world.touching(felt, looking_down(rng, touches, 15.0, 15.0))
    data = SphereData(
        poses=world.believed(q),
        profiles=list(profiles),
        radius_m=RADIUS_M,
        touches=world.believed(touch_q),
        tip=world.tip_believed,
        arm=world.cell.arm,
        q=q,
        touch_q=touch_q,
    )
    tests = None
    if views:
        points = world.cell.center + np.repeat(
            [[0.04, -0.06, 0.01], [-0.05, 0.02, -0.015], [0.01, 0.07, 0.025]], views, axis=0
        )
        m = len(points)
        at = np.column_stack([rng.uniform(-0.015, 0.015, m), np.zeros(m), rng.uniform(0.19, 0.225, m)])
        tests = measured_and_touched(world, points, at, looking_down(rng, m, 12.0, 10.0), rng)
    return SphereTrial(data, sign, np.arange(n) < translations, tests)


def measured_and_touched(
    world: SphereWorld, points: Floats, p_S: Floats, R_BS: Floats, rng: np.random.Generator
) -> SphereTests:
    """Points (n, 3) brought into the real scan plane at about p_S, measured, and touched with the real tip."""
    R, p = world.viewing(R_BS, p_S, points)
    for _ in range(4):
        X = world.poses(world.joints(R, p))
        across = X.rotation @ world.rotation[:, 1]
        p = p + world.in_scanner(X, points)[:, 1:2] * across
    q = world.joints(R, p)
    seen = world.measured(world.in_scanner(world.repeated(q, rng), points)[:, [0, 2]], rng)
    touch = world.touching(points, looking_down(rng, len(points), 0.0, 0.0))
    return SphereTests(q, seen, touch, np.repeat(np.arange(3), len(points) // 3))


MM = 1e-3
LENGTH_M, SWING_M, DEPTH_M = 0.300, 0.025, 0.060
HALF_M = DEPTH_M * np.tan(np.radians(22.5))
STATIONS = 25
TOP_M, HIP_M = 0.040, 0.050


@dataclass(frozen=True, eq=False)
class GrooveScan:
    """Joints (n, 6), raw profiles (n, m, 2) m, true features (n, 3, 2) m as the sensor shows it, touches (n, 3, 6)."""

    q: Floats
    profiles: Floats
    features: Floats
    q_touch: Floats


def seam_line(u: Floats, offset_m: float) -> Floats:
    """Points (n, 2) at a distance from the seam y = A sin(2 pi x / L)."""
    w = 2.0 * np.pi / LENGTH_M
    slope = SWING_M * w * np.cos(w * u)
    n = np.column_stack([-slope, np.ones_like(u)]) / np.hypot(1.0, slope)[:, None]
    return np.asarray(np.column_stack([u, SWING_M * np.sin(w * u)]) + offset_m * n)


def groove_lines(depth_m: float) -> tuple[tuple[float, float], ...]:
    """Return offset from the seam and height, m, of edge, root and edge of a groove of 45 deg."""
    half = depth_m * np.tan(np.radians(22.5))
    return (-half, 0.0), (0.0, -depth_m), (half, 0.0)


def groove_mesh(depth_m: float = DEPTH_M) -> TriMesh:
    """Plate with the groove: strips ruled between lines along the seam; its top at z = 0."""
    u = np.linspace(-0.05, LENGTH_M + 0.05, 1601)
    lines = [(-0.07, 0.0), *groove_lines(depth_m), (0.07, 0.0)]
    vertices = np.vstack([np.column_stack([seam_line(u, offset), np.full(len(u), z)]) for offset, z in lines])
    n = len(u)
    k = np.arange(n - 1)
    quads = [(j * n + k, j * n + k + 1, (j + 1) * n + k + 1, (j + 1) * n + k) for j in range(len(lines) - 1)]
    triangles = np.vstack([np.column_stack(t) for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return TriMesh(vertices, triangles)


def boss_mesh() -> TriMesh:
    """Return a square frustum on a plate, its base at z = 0; slanted edges of 50 mm, sides inclined by atan(4/3)."""
    k = HIP_M / np.sqrt(34.0)
    half, base, height = 0.5 * TOP_M, 0.5 * TOP_M + 3 * k, 4 * k
    ring = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    vertices = np.vstack(
        [np.column_stack([s * ring, np.full(4, z)]) for s, z in ((0.2, 0.0), (base, 0.0), (half, height))]
    )
    faces = [[8, 9, 10], [8, 10, 11]]
    for j in range(2):
        for i in range(4):
            a, b = 4 * j + i, 4 * j + (i + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    return TriMesh(vertices, np.array(faces))


def _perfect(width_m: float, samples: int) -> ProfilerPreset:
    return ProfilerPreset(samples=samples, width_m=width_m, near_m=0.12, far_m=0.30)


def _seen(
    world: SphereWorld, mesh: TriMesh, turn: Floats, place: Floats, X: FlangePoses, preset: ProfilerPreset
) -> Floats:
    """Return profiles (n, m, 2) without noise, of a mesh at X_BP = (turn, place)."""
    R = np.einsum("ji,njk->nik", turn, X.rotation @ world.rotation)
    o = (X.rotation @ world.translation + X.translation - place) @ turn
    return cast_profiles(mesh.scene, R, o, preset)


def scan_groove(
    world: SphereWorld, seed: int, *, depth_m: float = DEPTH_M, stations: int = STATIONS, middle_m: float = 0.195
) -> GrooveScan:
    """Stations along the groove, the laser line across it; 2 % spikes and 3 % gaps in the profiles.

    ``middle_m`` is the distance at which the sensor sees the middle of the plate's top (its z), less the tilt.
    """
    rng = np.random.default_rng([seed, 73])
    place = world.cell.groove
    turn = Rotation.from_euler("z", world.cell.groove_turn_deg, degrees=True).as_matrix()
    u = np.linspace(0.008, LENGTH_M - 0.008, stations)
    w = 2.0 * np.pi / LENGTH_M
    yaw = np.arctan(SWING_M * w * np.cos(w * u))
    across = np.column_stack([-np.sin(yaw), np.cos(yaw), np.zeros(stations)])
    down = np.tile([0.0, 0.0, -1.0], (stations, 1))
    R_PS = np.stack([across, np.cross(down, across), down], axis=2)
    R_PS = R_PS @ Rotation.from_euler("ZYX", rng.uniform(-3, 3, (stations, 3)), degrees=True).as_matrix()
    on = np.column_stack([seam_line(u, 0.0), np.zeros(stations)]) @ turn.T + place
    p_S = np.column_stack([rng.uniform(-0.003, 0.003, stations), np.zeros(stations), np.full(stations, middle_m)])
    q = world.joints(*world.viewing(turn @ R_PS, p_S, on))
    X = world.repeated(q, rng)
    clean = _seen(world, groove_mesh(depth_m), turn, place, X, _perfect(0.088, 440))
    p = world.measured(clean, rng)
    spikes = rng.random(p.shape[:2]) < 0.02
    p[spikes, 1] += rng.uniform(-0.015, 0.015, int(spikes.sum()))
    p[rng.random(p.shape[:2]) < 0.03] = np.nan
    fine = np.linspace(-0.05, LENGTH_M + 0.05, 40001)
    features, touched = np.empty((stations, 3, 2)), np.empty((stations, 3, 3))
    for j, (offset, z) in enumerate(groove_lines(depth_m)):
        line = np.column_stack([seam_line(fine, offset), np.full(len(fine), z)]) @ turn.T + place
        for k in range(stations):
            one = FlangePoses(X.rotation[[k] * len(fine)], X.translation[[k] * len(fine)])
            y = (((line - one.translation[0]) @ one.rotation[0]) - world.translation) @ world.rotation
            near = np.flatnonzero((np.diff(np.sign(y[:, 1])) != 0) & (np.abs(y[:-1, 0]) < 0.05))
            i = near[np.argmin(np.abs(y[near, 0]))]
            share = y[i, 1] / (y[i, 1] - y[i + 1, 1])
            features[k, j] = (y[i] + share * (y[i + 1] - y[i]))[[0, 2]]
            touched[k, j] = line[i] + share * (line[i + 1] - line[i])
    order = np.argsort(features[:, :, 0], axis=1)
    features = np.take_along_axis(features, order[:, :, None], axis=1)
    touched = np.take_along_axis(touched, order[:, :, None], axis=1)
    R_touch = np.tile(DOWN, (3 * stations, 1, 1))
    q_touch = world.touching(touched.reshape(-1, 3), R_touch).reshape(stations, 3, 6)
    calm = replace(world, errors=replace(world.errors, noise_m=0.0))
    return GrooveScan(q, p, calm.measured(features, rng), q_touch)


def scan_boss(world: SphereWorld, seed: int, profiles: int = 90) -> tuple[Floats, Floats]:
    """Joints (n, 6) and raw profiles (n, m, 2) m of the frustum, the line at 45 deg to its sides."""
    rng = np.random.default_rng([seed, 74])
    turn = Rotation.from_euler("z", 12.0, degrees=True).as_matrix()
    R = DOWN @ Rotation.from_euler("ZYX", [world.cell.boss_yaw_deg, -2.0, 3.0], degrees=True).as_matrix()
    along = R[:, 1] * [1.0, 1.0, 0.0]
    at = world.cell.boss + np.linspace(-0.08, 0.08, profiles)[:, None] * along
    q = world.joints(*world.viewing(np.tile(R, (profiles, 1, 1)), np.tile([0.0, 0.0, 0.205], (profiles, 1)), at))
    clean = _seen(world, boss_mesh(), turn, world.cell.boss, world.repeated(q, rng), _perfect(0.144, 320))
    return q, world.measured(clean, rng)


@dataclass(frozen=True, eq=False)
class WorldData:
    """One world: what is calibrated from, and what is measured afterwards where there is any."""

    trial: SphereTrial
    groove: GrooveScan | None = None
    boss: tuple[Floats, Floats] | None = None
    sigmas: SphereSigmas | None = None


def made_worlds(count: int, seed: int, grooves: int, bosses: int) -> Iterator[WorldData]:
    """Made from seeds, as the fixed files were; no two seeds share a world."""
    for k in range(count):
        one = 1000 * seed + k
        world = SphereWorld.like_the_files(one)
        groove = scan_groove(world, one) if k < grooves else None
        yield WorldData(sphere_trial(world, one), groove, scan_boss(world, one) if k < bosses else None)


def fixed_worlds(folder: Path, count: int) -> Iterator[WorldData]:
    """Of the fixed files.

    Raises:
        InputError: they are not there.
    """
    for name in ("sphere", "groove", "boss"):
        if not (folder / f"{name}.npz").is_file():
            raise InputError(f"There is no {name}.npz in '{folder}': omit --data to make worlds from seeds.")
    d, g, b = (dict(np.load(folder / f"{name}.npz")) for name in ("sphere", "groove", "boss"))
    arm = DhArm.checked(d["dh_nominal"] * [MM, np.radians(1.0), MM, np.radians(1.0)])
    for w in range(min(count, len(d["scan_T"]))):
        data = SphereData(
            poses=_poses(d["scan_T"][w]),
            profiles=[p * MM for p in d["scan_prof"][w].astype(float)],
            radius_m=float(d["radius"]) * MM,
            touches=_poses(d["touch_T"][w]),
            tip=d["tip_nominal"][w] * MM,
            arm=arm,
            q=d["scan_q"][w],
            touch_q=d["touch_q"][w],
        )
        tests = SphereTests(d["test_q_view"][w], d["test_m"][w] * MM, d["test_q_touch"][w], d["test_point"][w])
        groove = boss = None
        if w < len(g["q"]):
            groove = GrooveScan(g["q"][w], g["prof"][w].astype(float) * MM, g["feat"][w] * MM, g["q_touch"][w])
        if w < len(b["q"]):
            boss = b["q"][w], b["prof"][w].astype(float) * MM
        yield WorldData(SphereTrial(data, d["scan_sign"][w], d["scan_kind"][w] == 0, tests), groove, boss)


def _poses(T: Floats) -> FlangePoses:
    return FlangePoses(T[:, :3, :3], T[:, :3, 3] * MM)


def cast_profiles(scene: Any, rotation: np.ndarray, translation: np.ndarray, preset: ProfilerPreset) -> np.ndarray:
    """What a perfect profiler sees (n, samples, 2) [x, z] m from poses R_WS (n, 3, 3), p_WS (n, 3) m.

    NaN: nothing in range.
    """
    x = preset.x_m
    start = translation[:, None] + x[None, :, None] * rotation[:, None, :, 0]
    rays = np.concatenate([start, np.broadcast_to(rotation[:, None, :, 2], start.shape)], axis=2)
    hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays.astype(np.float32)))["t_hit"].numpy().astype(float)
    hit[~((hit >= preset.near_m) & (hit <= preset.far_m))] = np.nan
    return np.stack([np.broadcast_to(x, hit.shape), hit], axis=2)
