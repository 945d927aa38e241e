"""Simulated wrist depth camera: takes one picture of the true geometry per trigger."""

import dataclasses as dc
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import ClippingRange, ColorRenderCamera, DepthRange, DepthRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, State
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U, RgbdSensor

from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.picture_scene import add_picture_scene
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.jobs.tablet.config import TabletTruth, WristPicture
from weldcal.systems.leaf_system import LeafSystem

RENDERER = "wrist"
_NEAR_M, _FAR_M = 0.05, 2.0


@dc.dataclass(kw_only=True)
class RenderedWristCamera(DriverConfig):
    """`!RenderedWristCamera`: the camera's nominal pose on the flange, the true pose's deviation, and its noise."""

    FOR: ClassVar[tuple[str, ...]] = ("wrist_camera",)
    SIMULATED: ClassVar[bool] = True
    xyz_m: list[float] = dc.field(default_factory=lambda: [0.075, 0.0, 0.030])  # nominal X_FC
    rpy_deg: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 90.0])
    mounting_translation_mm: float = 4.0  # deviation of the true pose from the nominal one, drawn from the seed
    mounting_rotation_deg: float = 2.0
    width: int = 640
    height: int = 480
    focal_px: float = 617.7
    noise_grey: float = 2.0
    depth_scale: float = 0.985  # scale factor of the measured depth
    depth_noise_mm: float = 0.8

    def nominal(self) -> RigidTransform:
        """Return the nominal X_FC."""
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz_m)

    def camera_matrix(self) -> NDArray[np.float64]:
        """K (3, 3), centre of the first pixel at (0, 0)."""
        f, cx, cy = self.focal_px, 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


class WristCamera(LeafSystem):
    """Takes a picture when the trigger increases.

    .. pydrake_system::

        name: WristCamera
        input_ports:
        - trigger
        - color_image
        - depth_image
        output_ports:
        - picture

    `trigger` (1) is the sequence number of the newest requested picture; its noise follows from seed and number.
    """

    def __init__(self, config: RenderedWristCamera, seed: int, period_s: float = 0.02) -> None:
        super().__init__()
        self._config, self._seed = config, seed
        size = (config.width, config.height)
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        self._color = self.DeclareAbstractInputPort("color_image", AbstractValue.Make(ImageRgba8U(*size)))
        self._depth = self.DeclareAbstractInputPort("depth_image", AbstractValue.Make(ImageDepth32F(*size)))
        self._shown = self.DeclareAbstractState(AbstractValue.Make(WristPicture()))
        self.DeclareStateOutputPort("picture", self._shown)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        shown: WristPicture = context.get_abstract_state(self._shown).get_value()
        wanted = int(self._trigger.Eval(context)[0])
        if wanted <= shown.sequence:
            return
        rng, config = np.random.default_rng([self._seed, wanted]), self._config
        colour = np.asarray(self._color.Eval(context).data[:, :, :3], dtype=float)
        grey = colour @ np.array([0.299, 0.587, 0.114])
        noisy = np.clip(np.round(grey + rng.normal(0.0, config.noise_grey, grey.shape)), 0, 255).astype(np.uint8)
        depth = np.array(self._depth.Eval(context).data[:, :, 0], dtype=float)
        depth = config.depth_scale * depth + rng.normal(0.0, 1e-3 * config.depth_noise_mm, depth.shape)
        depth[~np.isfinite(depth)] = 0.0
        picture = WristPicture(wanted, context.get_time(), noisy, depth)
        state.get_mutable_abstract_state(self._shown).set_value(picture)


def ApplyDriverConfig(config: RenderedWristCamera, build: StationBuild) -> None:
    """Mount the camera on the simulated flange at its true pose (exported by `cheat.truth` only)."""
    world, builder = build.require(SimulatedWorld), build.builder
    view = add_picture_scene(builder, world.plant, world.scene_graph, RENDERER, mount="flange")
    K = config.camera_matrix()
    core = RenderCameraCore(
        view.renderer,
        # Drake samples pixel (u, v) at (u + 0.5, v + 0.5)
        CameraInfo(config.width, config.height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5),
        ClippingRange(0.02, 3.0),
        RigidTransform(),
    )
    flange = view.frames[world.plant.GetBodyByName("flange", world.arm).index()]
    depth = DepthRenderCamera(core, DepthRange(_NEAR_M, _FAR_M))
    sensor = builder.AddNamedSystem(
        "wrist_rgbd", RgbdSensor(flange, build.require(TabletTruth).X_FC, ColorRenderCamera(core, False), depth)
    )
    camera = WristCamera(config, int(build.rng.integers(2**31)))
    build.add("wrist_camera", camera, "wrist_camera.trigger", "wrist_camera.picture")
    builder.Connect(view.scene_graph.get_query_output_port(), sensor.query_object_input_port())
    builder.Connect(sensor.color_image_output_port(), camera.GetInputPort("color_image"))
    builder.Connect(sensor.depth_image_32F_output_port(), camera.GetInputPort("depth_image"))
