"""Simulated sets of flange scans, and folders of cells with several, clean or with one cause or fault.

The arm has joint zeros, link lengths, sag and repeatability of its own; the scanner a polynomial warp to the third
power, noise that grows with distance, and normals that bend at the rim.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial.transform import Rotation

from tests.worlds.cell import HOME, SPREAD_RAD, visible, wrong_arm
from weldcal.calibration.doctor.case import DoctorCase
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import Chain, chain_poses
from weldcal.models.arrays import Array
from weldcal.tools.report.render import csv_text

ARMS = ("ur10e", "ur5e")
FLANGE = "iso9409-1-50-4-m6"


@dataclass(frozen=True, eq=False, kw_only=True)
class DoctorWorld:
    """A cell in which scans are taken: the arm as its controller believes it, as it is, the camera and its errors."""

    rng: np.random.Generator
    name: str
    believed: Chain
    true: Chain
    zeros: Array
    X_BC: Array
    guess: Array
    warp: Array
    q: Array

    @property
    def n(self) -> int:
        """How many scans."""
        return len(self.q)


def make_world(seed: int, *, alike: bool = False) -> DoctorWorld:
    """Return a cell of its own for each seed: arm, scanner place, and 10 to 20 poses in front of the scanner."""
    rng = np.random.default_rng([seed, 18])
    name = ARMS[int(rng.integers(len(ARMS)))]
    believed = load_chain(name)
    true = wrong_arm(believed, rng.normal(size=(6, 6)) * np.repeat([4e-5, 2e-4], 3))
    zeros = np.radians(rng.normal(0.0, 0.02, believed.n))
    home = HOME + rng.normal(0.0, 0.1, 6)
    faced = pose(
        exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(rng.normal(0.0, 0.1, 3)), np.array([0.0, 0.0, 0.62])
    )
    X_BC = chain_poses(believed, home[None])[0] @ faced
    guess = X_BC @ pose(exp_rotation(rng.normal(0.0, 0.01, 3)), rng.normal(0.0, 0.008, 3))
    sigma = np.array([1.5e-3, *(6e-3,) * 2, *(8e-3,) * 3, *(0.02,) * 2])
    spread = SPREAD_RAD * (0.01 if alike else 0.6)
    wanted = int(rng.integers(10, 21))
    q = visible(believed, X_BC, rng, wanted, home=home, spread=spread, field=(0.21, 0.49, 0.75), tilt_deg=25.0)
    return DoctorWorld(
        rng=rng,
        name=name,
        believed=believed,
        true=true,
        zeros=zeros,
        X_BC=X_BC,
        guess=guess,
        warp=rng.normal(0.0, sigma),
        q=q,
    )


def observe(
    world: DoctorWorld, X_BF: Array, X_BC: Array | None = None, believed: Array | None = None, *, soft: float = 0.0
) -> DoctorCase:
    """What the scanner sees of the true flange poses (n, 4, 4).

    ``believed`` is what the controller states, ``soft`` the distance (m) from which on the image is out of focus (0:
    nowhere).
    """
    rng, n = world.rng, len(X_BF)
    X_CF = inverse(np.broadcast_to(world.X_BC if X_BC is None else X_BC, (n, 4, 4))) @ X_BF
    c, m = X_CF[:, :3, 3], X_CF[:, :3, 2]
    u = c - np.array(np.array([0.0, 0.0, 0.62]))
    w = world.warp
    factor = (
        1.0
        + w[0]
        + u[:, :2] @ w[1:3]
        + w[3] * u[:, 0] ** 2
        + w[4] * u[:, 0] * u[:, 1]
        + w[5] * u[:, 1] ** 2
        + (u[:, :2] ** 3) @ w[6:8]
    )
    far = (c[:, 2] / 0.62) ** 2
    blur = 1.0 if soft == 0.0 else 1.0 + 6.0 * np.clip((c[:, 2] - soft) / 0.08, 0.0, 3.0)
    seen = c * factor[:, None] + rng.normal(0.0, 4e-5, (n, 3)) * (far * blur)[:, None]
    bent = 4e-4 * u[:, [1, 0]] / 0.1
    turn = (
        np.column_stack([bent, np.zeros(n)]) + rng.normal(0.0, 6e-4, (n, 3)) * np.atleast_1d(blur * np.ones(n))[:, None]
    )
    normals = np.einsum("kij,kj->ki", exp_rotation(turn), m)
    noise = 6e-5 * far * blur * np.exp(rng.normal(0.0, 0.12, n))
    return DoctorCase(
        ids=tuple(f"scan{k + 1:02d}" for k in range(n)),
        X_BF=chain_poses(world.believed, world.q) if believed is None else believed,
        c=seen,
        m=normals / np.linalg.norm(normals, axis=1)[:, None],
        time=np.cumsum(rng.uniform(8.0, 15.0, n)),
        noise=noise,
        coverage=np.clip(rng.normal(0.97, 0.02, n), 0.0, 1.0),
        robot=world.name,
        guess=world.guess,
        guess_radius=0.06,
        flange=FLANGE,
    )


def true_poses(world: DoctorWorld) -> Array:
    """Flange poses X_BF (n, 4, 4) as they are: the arm's own lengths, zeros, sag and repeatability."""
    sag = np.zeros_like(world.q)
    sag[:, 1] = 4e-5 * np.cos(world.q[:, 1])
    q = world.q + world.zeros + sag + world.rng.normal(0.0, 1.2e-5, world.q.shape)
    return chain_poses(world.true, q)


def clean(seed: int) -> DoctorCase:
    """Return a set without a cause."""
    world = make_world(seed)
    return observe(world, true_poses(world))


def _moved(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng, n = world.rng, world.n
    k = int(rng.integers(max(3, n // 3), n - max(3, n // 3) + 1))
    X = true_poses(world)
    turn = exp_rotation(_direction(rng) * np.radians(rng.uniform(0.05, 0.5)))
    shifted = world.X_BC.copy()
    shifted[:3, :3] = turn @ shifted[:3, :3]
    shifted[:3, 3] += _direction(rng) * rng.uniform(1.5e-3, 6e-3)
    X_BC = np.where((np.arange(n) < k)[:, None, None], world.X_BC, shifted)
    return observe(world, X, X_BC)


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _tcp(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng = world.rng
    t = np.array([rng.normal(0.0, 0.02), rng.normal(0.0, 0.02), rng.uniform(0.03, 0.25)])
    turn = exp_rotation(_direction(rng) * (np.radians(rng.uniform(10.0, 60.0)) if rng.uniform() < 0.4 else 0.0))
    return observe(world, true_poses(world), believed=chain_poses(world.believed, world.q) @ pose(turn, t))


def _quaternion(seed: int) -> DoctorCase:
    world = make_world(seed)
    X = chain_poses(world.believed, world.q)
    first = bool(world.rng.uniform() < 0.5)
    stored = Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=first)
    wrong = Rotation.from_quat(stored, scalar_first=not first).as_matrix()
    return observe(world, true_poses(world), believed=pose(wrong, X[:, :3, 3]))


def _installation(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng = world.rng
    kind = int(rng.integers(3))
    turn = np.radians(float(rng.choice([45.0, 90.0, -90.0, 180.0]))) if kind == 0 else 0.0
    tilt = np.radians(float(rng.choice([45.0, 90.0, 180.0]))) if kind == 1 else 0.0
    shift = _direction(rng) * rng.uniform(0.15, 0.5) if kind == 2 else np.zeros(3)
    X = pose(Rotation.from_euler("xz", [tilt, turn]).as_matrix(), shift)
    return observe(world, true_poses(world), believed=X @ chain_poses(world.believed, world.q))


def _flange(seed: int) -> DoctorCase:
    names = ("iso9409-1-40-4-m6", "iso9409-1-63-4-m6", "iso9409-1-31.5-4-m5")
    return replace(clean(seed), fits_flange=names[seed % 3])


def _units(seed: int) -> DoctorCase:
    case = clean(seed)
    rng = np.random.default_rng([seed, 5])
    X = case.X_BF.copy()
    which = rng.uniform(size=case.n) < 0.3
    which[int(rng.integers(case.n))] = True
    if rng.uniform() < 0.3:
        which[:] = True
    X[which, :3, 3] *= float(rng.choice([1e3, 25.4])) if which.all() else 1e3
    return case.with_poses(X)


def _alike(seed: int) -> DoctorCase:
    world = make_world(seed, alike=True)
    return observe(world, true_poses(world))


def _focus(seed: int) -> DoctorCase:
    world = make_world(seed)
    return observe(world, true_poses(world), soft=float(world.rng.uniform(0.57, 0.64)))


def _drift(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng, n = world.rng, world.n
    t = np.linspace(0.0, 1.0, n)
    tau = float(rng.uniform(0.2, 0.8))
    f = (1.0 - np.exp(-t / tau)) / (1.0 - np.exp(-1.0 / tau))
    X_BC = np.broadcast_to(world.X_BC, (n, 4, 4)).copy()
    X_BC[:, :3, 3] += f[:, None] * (_direction(rng) * rng.uniform(0.8e-3, 3e-3))
    X_BC[:, :3, :3] = exp_rotation(f[:, None] * _direction(rng) * np.radians(rng.uniform(0.0, 0.1))) @ X_BC[:, :3, :3]
    return observe(world, true_poses(world), X_BC)


def _slack(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng, n = world.rng, world.n
    X = true_poses(world)
    jump = _direction(rng) * rng.uniform(0.8e-3, 3e-3)
    if rng.uniform() < 0.5:  # as gravity pulls
        state = X[:, :3, 0] @ np.array([0.0, 0.0, 1.0])
        state = state > np.median(state)
    else:
        state = rng.permutation(n) < n // 2
    if rng.uniform() < 0.7:
        return observe(world, X @ pose(np.eye(3), state[:, None] * jump))
    X_BC = np.broadcast_to(world.X_BC, (n, 4, 4)).copy()
    X_BC[:, :3, 3] += state[:, None] * jump
    return observe(world, X, X_BC)


def _kinematics(seed: int) -> DoctorCase:
    world = make_world(seed)
    rng = world.rng
    if rng.uniform() < 0.3:
        other = {"ur10e": "ur10", "ur5e": "ur5"}[world.name]
        believed = chain_poses(load_chain(other), world.q)
        return replace(observe(world, true_poses(world), believed=believed), robot=other)
    stack = world.believed.stack.copy()
    stack[1:, :3, 3] += rng.normal(0.0, 1.5e-3, (world.believed.n - 1, 3)) * (np.abs(stack[1:, :3, 3]) > 1e-3)
    wrong = replace(world.believed, stack=stack)
    q = world.q + np.radians(rng.normal(0.0, 0.25, world.q.shape[1]))
    return observe(world, true_poses(world), believed=chain_poses(wrong, q))


def _outliers(seed: int) -> DoctorCase:
    case = clean(seed)
    rng = np.random.default_rng([seed, 7])
    bad = rng.permutation(case.n)[: int(rng.integers(1, max(2, case.n // 5) + 1))]
    c, coverage = case.c.copy(), np.array(case.coverage)
    for k in bad:
        c[k] += _direction(rng) * rng.uniform(2.5e-3, 2e-2)
        coverage[k] = rng.uniform(0.3, 0.5)
    return replace(case, c=c, coverage=coverage)


CAUSES: dict[str, Callable[[int], DoctorCase]] = {
    "scanner moved": _moved,
    "TCP set at the controller": _tcp,
    "wrong quaternion order": _quaternion,
    "robot in another installation": _installation,
    "wrong flange size": _flange,
    "unit mix": _units,
    "poses too alike": _alike,
    "scanner out of focus or range": _focus,
    "warm-up drift": _drift,
    "slack flange or loose mount": _slack,
    "wrong kinematics file": _kinematics,
    "outlier scans or partial views": _outliers,
}
"""What each cause does to a set, by seed."""


FAULTS = ("none", "moved", "drifts", "broken")
SHARES = (0.7, 0.1, 0.1, 0.1)
COLUMNS = ("id", *(f"base_{c}" for c in (*"xyz", "qw", "qx", "qy", "qz")), *(f"camera_{c}" for c in "xyz"))
HEADER = (
    "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nconfiguration: eye_on_base\nunits: {clouds: m, poses: m}\n"
)
SCANS = 20
NOISE_M = 1.0e-4  # of a flange centre, one sigma, an axis
ROBOT_M = 1.0e-4  # amplitude of the robot's position error, smooth over the work space
SCALE = 5.0e-4  # of the scanner, one sigma over the fleet
MOVED_M, MOVED_DEG = (0.0015, 0.004), 0.15
DRIFT_M = 0.0002  # from one dataset to the next
LEFT = 2  # pairs in a broken dataset


def write_fleet(folder: Path, cells: int, datasets: int, seed: int) -> dict[str, str]:
    """Write ``cells`` cells with ``datasets`` datasets each; the fault of each cell by its name."""
    rng = np.random.default_rng(seed)
    faults = {}
    for k in range(cells):
        name = f"cell_{k:03d}"
        faults[name] = FAULTS[rng.choice(len(FAULTS), p=SHARES)]
        write_cell(folder / name, faults[name], datasets, rng)
    return faults


def write_cell(folder: Path, fault: str, datasets: int, rng: np.random.Generator) -> None:
    """Write one cell with a fault of FAULTS: its datasets by month."""
    X_BC = RigidTransform(
        RollPitchYaw(np.pi + rng.normal(0.0, 0.1), rng.normal(0.0, 0.1), rng.uniform(-3, 3)), [0.6, 0.0, 1.2]
    )
    scale = 1.0 + SCALE * rng.normal()
    waves = rng.normal(size=(3, 3)) * 4.0, rng.uniform(0.0, 2 * np.pi, 3)
    way = _direction(rng)
    since = int(rng.integers(1, datasets)) if datasets > 1 else 0
    step = RigidTransform(
        RollPitchYaw(np.radians(MOVED_DEG) * _direction(rng)), rng.uniform(*MOVED_M) * _direction(rng)
    )
    for k in range(datasets):
        X = X_BC
        if fault == "moved" and k >= since:
            X = X_BC @ step
        elif fault == "drifts":
            X = RigidTransform(k * DRIFT_M * way) @ X_BC
        _write_dataset(
            folder / f"2026-{k + 1:02d}",
            X,
            scale,
            waves,
            rng,
            LEFT if fault == "broken" and k == datasets - 1 else SCANS,
        )


def _write_dataset(
    folder: Path, X_BC: RigidTransform, scale: float, waves: tuple[Array, Array], rng: np.random.Generator, scans: int
) -> None:
    p = np.array([0.6, 0.0, 0.3]) + rng.uniform(-1.0, 1.0, (scans, 3)) * [0.25, 0.3, 0.2]
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.35, (scans, 3)))
    true = p + ROBOT_M * np.sin(p @ waves[0] + waves[1])
    seen = scale * X_BC.inverse().multiply(true.T).T + NOISE_M * rng.standard_t(5, (scans, 3))
    q = turns.as_quat(scalar_first=True)
    rows = [[f"scan{i:02d}", *map(repr, map(float, (*p[i], *q[i], *seen[i])))] for i in range(scans)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pairs.csv").write_text(csv_text(COLUMNS, rows), encoding="utf-8")
    (folder / "dataset.yaml").write_text(HEADER, encoding="utf-8")
