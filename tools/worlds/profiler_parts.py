"""Workpieces under a simulated profiler: the S-shaped V-groove and the frustum; whole worlds with both, simulated or
from files."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.profilers import ProfilerPreset, cast_profiles, make_scene
from weldcal.tools.worlds.profiler import SphereTests, SphereTrial, SphereWorld, sphere_trial

MM = 1e-3
LENGTH_M, SWING_M, DEPTH_M = 0.300, 0.025, 0.060
HALF_M = DEPTH_M * np.tan(np.radians(22.5))
STATIONS = 25
TOP_M, HIP_M = 0.040, 0.050


@dataclass(frozen=True, eq=False)
class GrooveScan:
    """Joints (n, 6), raw profiles (n, m, 2) m, the true features (n, 3, 2) m as the sensor shows them, touch joints (n,
    3, 6)."""

    q: Floats
    profiles: Floats
    features: Floats
    q_touch: Floats


def _seam(u: Floats, offset_m: float) -> Floats:
    """Points (n, 2) at a distance from the seam y = A sin(2 pi x / L)."""
    w = 2.0 * np.pi / LENGTH_M
    slope = SWING_M * w * np.cos(w * u)
    n = np.column_stack([-slope, np.ones_like(u)]) / np.hypot(1.0, slope)[:, None]
    return np.asarray(np.column_stack([u, SWING_M * np.sin(w * u)]) + offset_m * n)


def groove_mesh() -> TriMesh:
    """Plate with the groove: strips ruled between lines along the seam; its top at z = 0."""
    u = np.linspace(-0.05, LENGTH_M + 0.05, 1601)
    lines = [(-0.07, 0.0), (-HALF_M, 0.0), (0.0, -DEPTH_M), (HALF_M, 0.0), (0.07, 0.0)]
    vertices = np.vstack([np.column_stack([_seam(u, offset), np.full(len(u), z)]) for offset, z in lines])
    n = len(u)
    k = np.arange(n - 1)
    quads = [(j * n + k, j * n + k + 1, (j + 1) * n + k + 1, (j + 1) * n + k) for j in range(len(lines) - 1)]
    triangles = np.vstack([np.column_stack(t) for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return TriMesh(vertices, triangles)


def boss_mesh() -> TriMesh:
    """A square frustum on a plate, its base at z = 0; slanted edges of 50 mm, sides inclined by atan(4/3)."""
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
    """Profiles (n, m, 2) without noise, of a mesh that stands at X_BP = (turn, place)."""
    R = np.einsum("ji,njk->nik", turn, X.rotation @ world.rotation)
    o = (X.rotation @ world.translation + X.translation - place) @ turn
    return cast_profiles(make_scene(mesh), R, o, preset)


def scan_groove(world: SphereWorld, seed: int) -> GrooveScan:
    """25 stations along the groove, the laser line across it; 2 % spikes and 3 % gaps in the profiles."""
    rng = np.random.default_rng([seed, 73])
    place = world.cell.groove
    turn = Rotation.from_euler("z", world.cell.groove_turn_deg, degrees=True).as_matrix()
    u = np.linspace(0.008, LENGTH_M - 0.008, STATIONS)
    w = 2.0 * np.pi / LENGTH_M
    yaw = np.arctan(SWING_M * w * np.cos(w * u))
    across = np.column_stack([-np.sin(yaw), np.cos(yaw), np.zeros(STATIONS)])
    down = np.tile([0.0, 0.0, -1.0], (STATIONS, 1))
    R_PS = np.stack([across, np.cross(down, across), down], axis=2)
    R_PS = R_PS @ Rotation.from_euler("ZYX", rng.uniform(-3, 3, (STATIONS, 3)), degrees=True).as_matrix()
    on = np.column_stack([_seam(u, 0.0), np.zeros(STATIONS)]) @ turn.T + place
    p_S = np.column_stack([rng.uniform(-0.003, 0.003, STATIONS), np.zeros(STATIONS), np.full(STATIONS, 0.195)])
    q = world.joints(*world.viewing(turn @ R_PS, p_S, on))
    X = world.repeated(q, rng)
    clean = _seen(world, groove_mesh(), turn, place, X, _perfect(0.088, 440))
    p = world.measured(clean, rng)
    spikes = rng.random(p.shape[:2]) < 0.02
    p[spikes, 1] += rng.uniform(-0.015, 0.015, int(spikes.sum()))
    p[rng.random(p.shape[:2]) < 0.03] = np.nan
    fine = np.linspace(-0.05, LENGTH_M + 0.05, 40001)
    features, touched = np.empty((STATIONS, 3, 2)), np.empty((STATIONS, 3, 3))
    for j, (offset, z) in enumerate(((-HALF_M, 0.0), (0.0, -DEPTH_M), (HALF_M, 0.0))):
        line = np.column_stack([_seam(fine, offset), np.full(len(fine), z)]) @ turn.T + place
        for k in range(STATIONS):
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
    R_touch = np.tile(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), (3 * STATIONS, 1, 1))
    q_touch = world.touching(touched.reshape(-1, 3), R_touch).reshape(STATIONS, 3, 6)
    calm = SphereWorld(**{**world.__dict__, "errors": type(world.errors)(**{**world.errors.__dict__, "noise_m": 0.0})})
    return GrooveScan(q, p, calm.measured(features, rng), q_touch)


def scan_boss(world: SphereWorld, seed: int, profiles: int = 90) -> tuple[Floats, Floats]:
    """Joints (n, 6) and raw profiles (n, m, 2) m of the frustum, the line at 45 deg to its sides."""
    rng = np.random.default_rng([seed, 74])
    turn = Rotation.from_euler("z", 12.0, degrees=True).as_matrix()
    place = world.cell.boss
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    R = down @ Rotation.from_euler("ZYX", [world.cell.boss_yaw_deg, -2.0, 3.0], degrees=True).as_matrix()
    along = R[:, 1] * [1.0, 1.0, 0.0]
    at = place + np.linspace(-0.08, 0.08, profiles)[:, None] * along
    q = world.joints(*world.viewing(np.tile(R, (profiles, 1, 1)), np.tile([0.0, 0.0, 0.205], (profiles, 1)), at))
    clean = _seen(world, boss_mesh(), turn, place, world.repeated(q, rng), _perfect(0.144, 320))
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
