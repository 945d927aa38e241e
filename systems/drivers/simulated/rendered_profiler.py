"""Simulated laser profiler: casts a fan of rays at the true geometry; adds noise, rounding and lost returns."""

import dataclasses as dc
from typing import ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import GeometryId
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.profilers import ProfilerPreset, with_noise
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.jobs.profiler.config import pose_of
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import ProfileScan, TorchTouch

FORCE_N = 0.02  # contact force above which a touch is reported


@dc.dataclass(kw_only=True)
class RenderedProfiler(DriverConfig):
    """`!RenderedProfiler`: nominal pose of the profiler on the flange, its deviation, and its measurement model.

    The numbers are those of the profiler in the straight-edge paper: 40 mm wide at 60 mm to 160 mm at 350 mm, rounded
    to 0.1 mm, and 0.16 mm of noise, here divided between each sample and the whole profile.
    """

    FOR: ClassVar[tuple[str, ...]] = ("profiler",)
    SIMULATED: ClassVar[bool] = True
    xyz_m: list[float] = dc.field(default_factory=lambda: [0.070, 0.0, 0.045])  # nominal X_FS
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 90.0])
    mounting_translation_mm: float = 4.0  # deviation of the true pose, drawn from the seed
    mounting_rotation_deg: float = 2.0
    samples: int = 480
    nearest_mm: float = 60.0
    farthest_mm: float = 350.0
    width_near_mm: float = 40.0
    width_far_mm: float = 160.0
    noise_mm: float = 0.16  # of each sample, in z
    jitter_mm: float = 0.15  # of the whole profile, in x and in z, from scan to scan
    quantum_mm: float = 0.1
    share_missing: float = 0.01
    share_spikes: float = 0.005
    grazing_deg: float = 78.0  # at this angle of incidence half of the samples return, 8 degrees steeper none
    exposure_s: float = 0.004

    @property
    def apex_m(self) -> float:
        """Distance of the fan's apex behind the origin of S, m."""
        widening = (self.width_far_mm - self.width_near_mm) / (self.farthest_mm - self.nearest_mm)
        return 1e-3 * (self.width_near_mm / widening - self.nearest_mm)

    @property
    def slopes(self) -> Array:
        """dx/dz (samples,) of the rays."""
        half = 0.5e-3 * self.width_near_mm / (1e-3 * self.nearest_mm + self.apex_m)
        return np.linspace(-half, half, self.samples)

    def pitch_m(self, z_m: float) -> float:
        """Distance (m) of neighbouring samples at a depth."""
        return float((z_m + self.apex_m) * (self.slopes[1] - self.slopes[0]))

    def preset(self) -> ProfilerPreset:
        """Return the noise of samples as a ProfilerPreset; raises InputError for numbers that no profiler has."""
        if (
            not self.width_far_mm > self.width_near_mm > 0.0
            or min(self.noise_mm, self.jitter_mm, self.exposure_s) < 0.0
        ):
            raise InputError("A profiler is wider far away than near, and its noise and exposure are not negative.")
        return ProfilerPreset(
            samples=self.samples,
            width_m=1e-3 * self.width_near_mm,
            near_m=1e-3 * self.nearest_mm,
            far_m=1e-3 * self.farthest_mm,
            sigma_x_m=0.0,
            sigma_z_m=1e-3 * self.noise_mm,
            quantum_m=1e-3 * self.quantum_mm,
            share_missing=self.share_missing,
            share_spikes=self.share_spikes,
        )


def last_step(now: float, step: float) -> float:
    """Time of the plant step that the plant's outputs show: at the time of a tick, the previous step."""
    return max(0.0, float((np.ceil(now / step - 1e-6) - 1.0) * step))


class RayFan:
    """Casts the fan of rays at the objects fixed in B: meshes, and the exact sphere."""

    def __init__(self, config: RenderedProfiler, fixture: ProfilerFixture) -> None:
        import open3d as o3d  # slow to import

        self._config = config
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        # relative to the sphere's centre, where single precision resolves 0.1 micrometre
        self._origin = np.array(fixture.truth.center)
        self._radius = fixture.truth.radius_m
        self._dark = []
        for mesh, dark in fixture.meshes:
            self._scene.add_triangles(
                self._tensor(np.asarray(mesh.vertices - self._origin, np.float32)),
                self._tensor(np.asarray(mesh.triangles, np.uint32)),
            )
            self._dark.append(dark)

    def cast(self, X_BS: RigidTransform) -> tuple[Array, Array, Array]:
        """Profile without noise (n, 2) m, NaN out of range; cosine (n,) of incidence; darkness (n,) 0 to 1."""
        c = self._config
        R = X_BS.rotation().matrix()
        slopes = c.slopes
        start = X_BS.translation() - self._origin - c.apex_m * R[:, 2]
        d = slopes[:, None] * R[:, 0] + R[:, 2]
        rays = np.hstack([np.broadcast_to(start, d.shape), d]).astype(np.float32)
        hit = self._scene.cast_rays(self._tensor(rays))
        t = hit["t_hit"].numpy().astype(float)
        normal = hit["primitive_normals"].numpy().astype(float)
        number = hit["geometry_ids"].numpy().astype(np.int64)
        # a miss is the largest representable number
        dark = np.array([*self._dark, 1.0])[np.minimum(number, len(self._dark))]
        t_ball, normal_ball = self._sphere(start, d)
        nearer = t_ball < t
        t, dark = np.where(nearer, t_ball, t), np.where(nearer, 0.0, dark)
        normal = np.where(nearer[:, None], normal_ball, normal)
        cosine = np.abs(np.einsum("ni,ni->n", normal, d)) / np.linalg.norm(d, axis=1)
        z = t - c.apex_m
        z = np.where((z >= 1e-3 * c.nearest_mm) & (z <= 1e-3 * c.farthest_mm), z, np.nan)
        return np.column_stack([slopes * (z + c.apex_m), z]), cosine, dark

    def _sphere(self, start: Array, d: Array) -> tuple[Array, Array]:
        """Where the rays enter the sphere at the scene's origin: t (n,), infinite for a miss, and normals."""
        a, b = np.einsum("ni,ni->n", d, d), d @ start
        root = b**2 - a * (start @ start - self._radius**2)
        t = np.where(root > 0.0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        return t, (start + np.where(np.isfinite(t), t, 0.0)[:, None] * d) / self._radius


def measured_profile(
    config: RenderedProfiler, clean: Array, cosine: Array, dark: Array, rng: np.random.Generator
) -> Array:
    """Apply the sensor model to a profile: jitter, noise, rounding, spikes; grazing and dark surfaces lose returns."""
    p = clean + 1e-3 * config.jitter_mm * rng.standard_normal(2)
    p = with_noise(p, config.preset(), rng)
    steep = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    lost = np.clip(0.5 + (steep - config.grazing_deg) / 16.0, 0.0, 1.0)
    lost[steep < config.grazing_deg - 8.0] = 0.0
    p[rng.random(len(p)) < 1.0 - (1.0 - lost) * (1.0 - dark)] = np.nan
    return p


class ProfilerSensor(LeafSystem):
    """Takes one profile when the trigger increases.

    .. pydrake_system::

        name: ProfilerSensor
        input_ports:
        - trigger
        - body_poses
        output_ports:
        - profile

    `trigger` (1) is the number of the newest requested profile. A profile shows the world at the plant's last step, and
    its capture time is the time of that step. It appears on `profile` after the exposure.
    """

    def __init__(
        self,
        config: RenderedProfiler,
        fixture: ProfilerFixture,
        flange: BodyIndex,
        seed: int,
        plant_period_s: float,
        period_s: float = 0.008,
    ) -> None:
        super().__init__()
        self._config, self._fixture, self._flange, self._seed = config, fixture, int(flange), seed
        self._step = plant_period_s
        self._fan = RayFan(config, fixture)
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        self._poses = self.DeclareAbstractInputPort("body_poses", AbstractValue.Make([RigidTransform()]))
        self._shown = self.DeclareAbstractState(AbstractValue.Make(ProfileScan()))
        self._pending = self.DeclareAbstractState(AbstractValue.Make(ProfileScan()))
        self.DeclareStateOutputPort("profile", self._shown)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        shown: ProfileScan = context.get_abstract_state(self._shown).get_value()
        pending: ProfileScan = context.get_abstract_state(self._pending).get_value()
        now = context.get_time()
        if pending.sequence > shown.sequence and now >= pending.capture_time + self._config.exposure_s - 1e-9:
            state.get_mutable_abstract_state(self._shown).set_value(pending)
        wanted = int(self._trigger.Eval(context)[0])
        if wanted <= pending.sequence:
            return
        X_BF = self._poses.Eval(context)[self._flange]
        clean, cosine, dark = self._fan.cast(X_BF @ self._fixture.truth.X_FS)
        points = measured_profile(self._config, clean, cosine, dark, np.random.default_rng([self._seed, wanted]))
        scan = ProfileScan(wanted, last_step(now, self._step), points)
        state.get_mutable_abstract_state(self._pending).set_value(scan)


class TouchSensor(LeafSystem):
    """Detects contact of the torch's tip with the sphere from the plant's contact results.

    It takes the place of the sphere paper's microcontroller.

    .. pydrake_system::

        name: TouchSensor
        input_ports:
        - contact_results
        output_ports:
        - touch
    """

    def __init__(self, pair: frozenset[GeometryId], plant_period_s: float, period_s: float = 0.004) -> None:
        super().__init__()
        self._pair, self._step = pair, plant_period_s
        self._contacts = self.DeclareAbstractInputPort("contact_results", AbstractValue.Make(ContactResults()))
        self._touch = self.DeclareAbstractState(AbstractValue.Make(TorchTouch()))
        self.DeclareStateOutputPort("touch", self._touch)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: TorchTouch = context.get_abstract_state(self._touch).get_value()
        results: ContactResults = self._contacts.Eval(context)
        felt = any(self._felt(results, k) for k in range(results.num_point_pair_contacts()))
        if felt == old.down:
            return
        # contact is computed at the start of the last step: one step before the poses that the plant's outputs show
        time = last_step(context.get_time(), self._step) - self._step
        new = TorchTouch(old.sequence + 1, time, True) if felt else dc.replace(old, down=False)
        state.get_mutable_abstract_state(self._touch).set_value(new)

    def _felt(self, results: ContactResults, k: int) -> bool:
        info = results.point_pair_contact_info(k)
        pair = info.point_pair()
        return {pair.id_A, pair.id_B} == self._pair and float(np.linalg.norm(info.contact_force())) > FORCE_N


class CheatTorch(LeafSystem):
    """Outputs the true position of the torch's tip.

    .. pydrake_system::

        name: CheatTorch
        input_ports:
        - body_poses
        output_ports:
        - torch

    `torch` (3) in B, m.
    """

    def __init__(self, fixture: ProfilerFixture, flange: BodyIndex) -> None:
        super().__init__()
        self._tip, self._flange = fixture.truth.p_FTip, int(flange)
        self._poses = self.DeclareAbstractInputPort("body_poses", AbstractValue.Make([RigidTransform()]))
        self.DeclareVectorOutputPort("torch", 3, self._torch)

    def _torch(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._poses.Eval(context)[self._flange].multiply(self._tip))


def drawn_pose(config: RenderedProfiler) -> RigidTransform:
    """Return the nominal X_FS."""
    return pose_of(config.xyz_m, config.rpy_deg)


def ApplyDriverConfig(config: RenderedProfiler, build: StationBuild) -> None:
    """Add the profiler at its true pose on the flange, and the sensor of the torch's touches."""
    world = build.require(SimulatedWorld)
    fixture, pair = build.require(ProfilerFixture), world.touch_pair
    if pair is None:
        raise RuntimeError("the profiler's fixture is not in the simulated world")
    plant, builder = world.plant, build.builder
    flange = plant.GetBodyByName("flange", world.arm).index()
    sensor = ProfilerSensor(config, fixture, flange, int(build.rng.integers(2**31)), plant.time_step())
    build.add("profiler", sensor, "profiler.trigger", "profiler.profile")
    touch = build.add("touch_sensor", TouchSensor(pair, plant.time_step()), "torch.touch")
    cheat = build.add("cheat_torch", CheatTorch(fixture, flange), "cheat.torch")
    for system in (sensor, cheat):
        builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    builder.Connect(plant.get_contact_results_output_port(), touch.GetInputPort("contact_results"))
