"""Simulated structured-light scanner: renders the depth of the true geometry and adds the scanner's noise."""

import dataclasses as dc
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    GeometryInstance,
    MakePhongIllustrationProperties,
    PerceptionProperties,
    RenderCameraCore,
    Rgba,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U, RgbdSensor

from weldcal.calibration.geometry.se3 import exp_rotation
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset, apply_noise, depth_to_points, drake_intrinsics, get_scanner
from weldcal.systems.drivers.config import ScannerConfig
from weldcal.systems.drivers.simulated.picture_scene import add_stand
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message, Scan


@dc.dataclass(kw_only=True)
class RenderedScanner(ScannerConfig):
    """`!RenderedScanner`: the preset of the simulated scanner, its nominal pose and the deviation from it."""

    DEFAULT_FOR: ClassVar[tuple[str, ...]] = ("scanner",)
    SIMULATED: ClassVar[bool] = True
    preset: str = "phoxi_m"  # or a scanner file, relative to the scenario: docs/scanners.md
    width: int | None = 824  # 0.5 Mpx; null: the scanner's full resolution
    height: int | None = 616
    xyz_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.95])  # nominal X_BC
    rpy_deg: list[float] = dc.field(default_factory=lambda: [180.0, 0.0, -90.0])
    mounting_translation_mm: float = 15.0  # deviation of the true pose from the nominal one, drawn from the seed
    mounting_rotation_deg: float = 1.5
    exposure_s: float = 0.25  # from the trigger to the cloud
    field_of_view_deg: float | None = None  # horizontal; null: the scanner's own
    # the device's own errors, the same in every scan: relative error of all lengths, the same per metre of x and y, and
    # the largest error of a smooth warp at the optimum distance, drawn from the seed
    scale_error: float = 0.0
    gradient_error_per_m: list[float] = dc.field(default_factory=lambda: [0.0, 0.0])
    warp_mm: float = 0.0
    # base, or flange, or a link of the arm: shoulder ... wrist_2; the nominal pose is then in its frame
    mounted_on: str = "base"
    # the stand is knocked at knock_s (null: never): the scanner then stands this far from its true pose, turned about
    # its own origin by this rotation vector, both along the axes of the base
    knock_s: float | None = None
    knock_mm: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])
    knock_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    def knock(self, X_BC: RigidTransform) -> RigidTransform:
        """Return the displacement, in the base, of a scanner at ``X_BC`` whose stand is hit."""
        R = RotationMatrix(exp_rotation(np.deg2rad(self.knock_deg)))
        p = X_BC.translation()
        return RigidTransform(R, p + 1e-3 * np.array(self.knock_mm) - R @ p)

    def put_at_nominal(self) -> tuple[list[float], list[float]]:
        """See ScannerConfig."""
        self.mounting_translation_mm = self.mounting_rotation_deg = 0.0
        return list(self.xyz_m), list(self.rpy_deg)

    def scanner(self) -> ScannerPreset:
        """The scanner with the configured resolution and field of view; the pixels' aspect ratio is unchanged."""
        return get_scanner(self.preset, self.width, self.height, self.field_of_view_deg)

    def device(self, rng: np.random.Generator) -> ScannerPreset:
        """Return the scanner with the errors of one device; ``rng`` draws its warp."""
        preset = self.scanner()
        if len(self.gradient_error_per_m) != 2:
            raise InputError("scanner.gradient_error_per_m must be two numbers, along x and along y.")
        own = preset.noise  # of a scanner file; a preset by name has no such errors
        gradient = (self.gradient_error_per_m[0], self.gradient_error_per_m[1])
        warp_m = self.warp_mm * 1e-3 or own.warp_m
        noise = dc.replace(
            own,
            scale_error=self.scale_error or own.scale_error,
            gradient_per_m=gradient if any(gradient) else own.gradient_per_m,
            warp_m=warp_m,
            # no draw where it is not needed: the other devices' random numbers stay the same
            device=int(rng.integers(2**31)) if warp_m else 0,
        )
        return dc.replace(preset, noise=noise)


def random_pose_error(rng: np.random.Generator, translation_m: float, rotation_rad: float) -> RigidTransform:
    """Return a pose error of exactly this magnitude (m, rad) in a random direction."""
    axis, direction = rng.normal(size=3), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    direction /= np.linalg.norm(direction)
    return RigidTransform(RotationMatrix(AngleAxis(rotation_rad, axis)), translation_m * direction)


BRIGHT_GREY = 80.0  # of 255: surfaces that reflect this much light or more count as bright


def darkness(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Darkness of each pixel of an image (H, W, 3), 0 to 255: 0 (bright) to 1 (black)."""
    luminance = rgb @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(np.clip(1.0 - luminance / BRIGHT_GREY, 0.0, 1.0), dtype=np.float32)


class DepthSensor(LeafSystem):
    """Takes one noisy organised cloud per trigger.

    .. pydrake_system::

        name: DepthSensor
        input_ports:
        - trigger
        - depth_image
        - color_image
        output_ports:
        - scan

    `trigger` (1) is the sequence number of the newest requested scan (open: none). When it increases, the depth image
    is rendered and the scanner's noise is added from the seed and the sequence number. The cloud appears on `scan`
    after the exposure.
    """

    def __init__(self, preset: ScannerPreset, seed: int, exposure_s: float, period_s: float = 0.02) -> None:
        super().__init__()
        self._preset = preset
        self._seed = seed
        self._exposure_s = exposure_s
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        self._depth = self.DeclareAbstractInputPort(
            "depth_image", AbstractValue.Make(ImageDepth32F(preset.width, preset.height))
        )
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(preset.width, preset.height))
        )
        self._shown = self.DeclareAbstractState(AbstractValue.Make(Scan()))
        self._pending = self.DeclareAbstractState(AbstractValue.Make(Scan()))
        self.DeclareStateOutputPort("scan", self._shown)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        shown: Scan = context.get_abstract_state(self._shown).get_value()
        pending: Scan = context.get_abstract_state(self._pending).get_value()
        now = context.get_time()
        if pending.sequence > shown.sequence and now >= pending.capture_time + self._exposure_s - 1e-9:
            state.get_mutable_abstract_state(self._shown).set_value(pending)
        wanted = int(self._trigger.Eval(context)[0]) if self._trigger.HasValue(context) else 0
        if wanted > pending.sequence:
            depth = np.array(self._depth.Eval(context).data[:, :, 0])
            rng = np.random.default_rng([self._seed, wanted])
            noisy = apply_noise(np.where(np.isfinite(depth), depth, 0.0), self._preset, rng, self._darkness(context))
            p = self._preset
            points = depth_to_points(noisy, p.fx, p.fy, p.cx, p.cy).astype(np.float32)
            scan = Scan(sequence=wanted, capture_time=now, points_C=points)
            state.get_mutable_abstract_state(self._pending).set_value(scan)

    def _darkness(self, context: Context) -> np.ndarray | None:
        """Darkness of each pixel's surface, 0 to 1, from the colour image; None where no colour image is connected."""
        if not self._color.HasValue(context):
            return None
        rgb = np.asarray(self._color.Eval(context).data[:, :, :3], dtype=np.float32)
        return darkness(rgb)


def _carrier(world: SimulatedWorld, mounted_on: str) -> RigidBody | None:
    """Return the body that carries the scanner; None: the scanner is fixed in the base."""
    if mounted_on == "base":
        return None
    return world.plant.GetBodyByName(mounted_on if mounted_on == "flange" else f"{mounted_on}_link", world.arm)


def _show_housing(world: SimulatedWorld, X_BC: RigidTransform, carrier: RigidBody | None) -> None:
    """Add the scanner's housing at its true pose, for viewers only: the scanner's own scene does not contain it."""
    scene_graph = world.scene_graph
    if carrier is not None:
        plant = world.plant
        size = Box(0.26, 0.07, 0.08)  # a short housing and its bracket
        housing = GeometryInstance(X_BC @ RigidTransform([0.0, 0.0, -0.045]), size, "scanner_housing")
        grey = np.array([0.18, 0.20, 0.23, 1.0])
        seen = PerceptionProperties()
        seen.AddProperty("phong", "diffuse", Rgba(*grey))
        housing.set_illustration_properties(MakePhongIllustrationProperties(grey))
        housing.set_perception_properties(seen)
        frame = plant.GetBodyFrameIdOrThrow(carrier.index())
        scene_graph.RegisterGeometry(plant.get_source_id(), frame, housing)
        return
    source = scene_graph.RegisterSource("scanner_housing")
    housing = GeometryInstance(X_BC @ RigidTransform([0.0, 0.0, -0.045]), Box(0.41, 0.08, 0.09), "scanner_housing")
    housing.set_illustration_properties(MakePhongIllustrationProperties(np.array([0.18, 0.20, 0.23, 0.30])))
    scene_graph.RegisterAnchoredGeometry(source, housing)


@dc.dataclass(frozen=True, eq=False)
class TrueScanner(Message):
    """The simulated scanner with its device's own errors, for reports and tests only."""

    device: ScannerPreset


@dc.dataclass(frozen=True, eq=False)
class MountedScanner:
    """A scanner at its true pose ``X_LC`` in its carrier's frame, its device's errors, and its renderer."""

    X_LC: RigidTransform
    device: ScannerPreset
    sensor: RgbdSensor


def mount_scanner(config: RenderedScanner, build: StationBuild) -> MountedScanner:
    """Add a depth camera at the scanner's true pose, which is drawn from the station's random numbers."""
    world = build.require(SimulatedWorld)
    nominal = RigidTransform(RollPitchYaw(np.deg2rad(config.rpy_deg)), config.xyz_m)
    error = random_pose_error(
        build.rng, config.mounting_translation_mm * 1e-3, np.deg2rad(config.mounting_rotation_deg)
    )
    X_BC = RigidTransform(nominal.rotation() @ error.rotation(), nominal.translation() + error.translation())
    preset = config.device(build.rng)
    carrier = _carrier(world, config.mounted_on)
    _show_housing(world, X_BC, carrier)
    view = world.scanner_view
    core = RenderCameraCore(
        view.renderer, CameraInfo(*drake_intrinsics(preset)), ClippingRange(0.05, 5.0), RigidTransform()
    )
    camera = DepthRenderCamera(core, DepthRange(preset.near_m, preset.far_m))
    colour = ColorRenderCamera(core, False)
    parent = view.scene_graph.world_frame_id() if carrier is None else view.frames[carrier.index()]
    if config.knock_s is not None:
        if carrier is not None:
            raise InputError("scanner.knock_s is for a scanner on a stand: write mounted_on: base, or leave it out.")
        parent = add_stand(build.builder, view, config.knock_s, config.knock(X_BC))
    sensor = build.builder.AddNamedSystem("scanner_depth", RgbdSensor(parent, X_BC, colour, camera))
    build.builder.Connect(view.scene_graph.get_query_output_port(), sensor.query_object_input_port())
    build.parts = (*build.parts, TrueScanner(preset))
    return MountedScanner(X_BC, preset, sensor)


def ApplyDriverConfig(config: RenderedScanner, build: StationBuild) -> RigidTransform:
    """Mount a depth camera at the scanner's true pose (exported by `cheat.*` only) and add the scanner's errors.

    Returns the true pose of the scanner in its carrier's frame: X_BC, X_FC or X_LC.
    """
    mounted = mount_scanner(config, build)
    scanner = DepthSensor(mounted.device, int(build.rng.integers(2**31)), config.exposure_s)
    build.add("scanner", scanner, "scanner.trigger", "scanner.scan")
    build.builder.Connect(mounted.sensor.depth_image_32F_output_port(), scanner.GetInputPort("depth_image"))
    build.builder.Connect(mounted.sensor.color_image_output_port(), scanner.GetInputPort("color_image"))
    return mounted.X_LC
