"""Adds the tablet job's bodies to the simulated world.

Plate, camera and sprung pen on the flange, tablet on the table.
"""

import dataclasses as dc
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Cylinder,
    GeometryId,
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    ProximityProperties,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import ContactResults, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import Context, State

from weldcal.systems.bodies.tool import DARK, STEEL
from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.rendered_scanner import random_pose_error
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.jobs.tablet.config import TabletConfig, TabletTouch, TabletTruth
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.viewer.scene import textured_board

GLASS, NIB = "tablet_glass", "pen_nib"  # names of the two contact geometries


@dc.dataclass
class SimulatedTablet(DriverConfig):
    """`!SimulatedTablet`: deviation of the tablet's true pose from the nominal one, and its touch threshold."""

    FOR: ClassVar[tuple[str, ...]] = ("digitizer",)
    SIMULATED: ClassVar[bool] = True
    placement_translation_mm: float = 4.0  # drawn from the seed
    placement_rotation_deg: float = 1.5
    touch_noise_px: float = 0.3
    touch_force_N: float = 0.02  # contact force above which the pen is detected


class TabletDigitizer(LeafSystem):
    """Detects the pen on the glass: a touch begins when the contact force exceeds its threshold, and counts once.

    .. pydrake_system::

        name: TabletDigitizer
        input_ports:
        - contact_results
        output_ports:
        - touch
    """

    def __init__(
        self,
        config: SimulatedTablet,
        px_per_m: float,
        pair: set[GeometryId],
        X_BT: RigidTransform,
        seed: int,
        period_s: float = 0.004,
    ) -> None:
        super().__init__()
        self._config, self._px_per_m, self._pair = config, px_per_m, pair
        self._X_TB, self._seed = X_BT.inverse(), seed
        self._contacts = self.DeclareAbstractInputPort("contact_results", AbstractValue.Make(ContactResults()))
        self._touch = self.DeclareAbstractState(AbstractValue.Make(TabletTouch()))
        self.DeclareStateOutputPort("touch", self._touch)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: TabletTouch = context.get_abstract_state(self._touch).get_value()
        felt = self._felt(self._contacts.Eval(context))
        if (felt is not None) == old.down:
            return
        if felt is None:
            new = dc.replace(old, down=False)
        else:
            rng = np.random.default_rng([self._seed, old.sequence + 1])
            px = self._px_per_m * felt + rng.normal(0.0, self._config.touch_noise_px, 2)
            new = TabletTouch(old.sequence + 1, context.get_time(), np.round(px, 1), True)
        state.get_mutable_abstract_state(self._touch).set_value(new)

    def _felt(self, results: ContactResults) -> np.ndarray | None:
        """Position on the page (2,) m of a contact above the threshold; None where there is none."""
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            surface = info.contact_surface()
            if {surface.id_M(), surface.id_N()} != self._pair:
                continue
            if np.linalg.norm(info.F_Ac_W().translational()) > self._config.touch_force_N:
                return np.asarray(self._X_TB.multiply(surface.centroid())[:2])
        return None


def _geometry(plant: MultibodyPlant, body: str, build: StationBuild, name: str) -> GeometryId:
    """Return the collision geometry of that name on a body."""
    inspector = build.require(SimulatedWorld).scene_graph.model_inspector()
    found = plant.GetCollisionGeometriesForBody(plant.world_body() if not body else plant.GetBodyByName(body))
    (geometry,) = (g for g in found if inspector.GetName(g).endswith(name))
    return geometry


def ApplyDriverConfig(config: SimulatedTablet, build: StationBuild) -> None:
    """Add the digitizer of the simulated tablet to the station."""
    plant = build.require(SimulatedWorld).plant
    pair = {_geometry(plant, "", build, GLASS), _geometry(plant, "pen", build, NIB)}
    px_per_m, X_BT = 1e3 * build.require(TabletConfig).px_per_mm, build.require(TabletTruth).X_BT
    tablet = TabletDigitizer(config, px_per_m, pair, X_BT, int(build.rng.integers(2**31)))
    build.add("tablet", tablet, "digitizer.touch")
    build.builder.Connect(plant.get_contact_results_output_port(), tablet.GetInputPort("contact_results"))


_TEXELS_PER_MM = 8
# a touch pen's: on its spring of 300 N/m it swings at 19 Hz, damped to 0.6; twice as much gives 14 Hz
_PEN_MASS_KG = 0.02
_PEN_DAMPING = 3.0  # N s / m
_PEN_MODULUS_PA = 1e7  # of the soft nib
_PEN_FRICTION = 0.1  # a choice: the pen yields only along its axis, so that friction bends nothing, whatever it is
_NIB_FACETS = 8.0  # edges of the contact model's nib per radius: the contact point is a centroid of its facets
_HOLE = 0.62  # of a ring's radius, as drawn on the page
_FRAME_M, _THICK_M = 0.010, 0.008  # width of the tablet's frame around the page, and its thickness
_CAMERA_BOX = Box(0.09, 0.024, 0.02)


@dataclass(frozen=True, eq=False)
class TabletFittings:
    """Bodies that `build_world` adds, at their true poses."""

    tablet: TabletConfig
    truth: TabletTruth

    def add(self, plant: MultibodyPlant, arm: ModelInstanceIndex) -> ModelInstanceIndex:
        """Add all bodies before the plant is finalised; returns the model instance of the bodies on the flange."""
        _add_tablet(plant, self.tablet, self.truth.X_BT)
        return _add_rig(plant, arm, self.tablet, self.truth)


def tablet_fittings(
    tablet: TabletConfig, camera: DriverConfig, page: DriverConfig, rng: np.random.Generator
) -> TabletFittings:
    """Draw the true poses of camera, pen and tablet from the seed.

    A device without a simulated driver has its nominal pose. The tablet lies flat; its error is a translation in the
    plane and a rotation about the normal.
    """
    X_FC, X_BT = RigidTransform(), tablet.pose()
    if isinstance(camera, RenderedWristCamera):
        off = random_pose_error(rng, 1e-3 * camera.mounting_translation_mm, np.deg2rad(camera.mounting_rotation_deg))
        drawn = camera.nominal()
        X_FC = RigidTransform(drawn.rotation() @ off.rotation(), drawn.translation() + off.translation())
    direction = rng.normal(size=3)
    p_FP = np.array(tablet.pen.tip_m) + 1e-3 * tablet.pen.mounting_mm * direction / np.linalg.norm(direction)
    if isinstance(page, SimulatedTablet):
        X_BT = X_BT @ random_pose_error(
            rng, 1e-3 * page.placement_translation_mm, np.deg2rad(page.placement_rotation_deg)
        )
    return TabletFittings(tablet, TabletTruth(X_FC, p_FP, X_BT))


def page_picture(tablet: TabletConfig) -> NDArray[np.uint8]:
    """Return the screen's picture (h, w), its first landmark `margin_mm` from the upper left corner."""
    size = 1e3 * tablet.landmarks_m().max(axis=0) + 2.0 * tablet.margin_mm
    w, h = (round(v * _TEXELS_PER_MM) for v in size)
    screen = np.full((h, w), 235, dtype=np.uint8)
    fine = 4  # fractional bits of OpenCV's centres and radii
    for k, p in enumerate(1e3 * tablet.landmarks_m() + tablet.margin_mm):
        x, y = (round((v * _TEXELS_PER_MM - 0.5) * 2**fine) for v in p)
        radius = 0.5 * tablet.ring_mm * _TEXELS_PER_MM * 2**fine
        cv2.circle(screen, (x, y), round(radius), 15, -1, cv2.LINE_AA, fine)
        if k > 0:
            cv2.circle(screen, (x, y), round(_HOLE * radius), 235, -1, cv2.LINE_AA, fine)
    return screen


def _show(
    plant: MultibodyPlant, body: RigidBody, X: RigidTransform, shape: Shape, name: str, rgba: tuple[float, ...]
) -> None:
    plant.RegisterVisualGeometry(body, X, shape, name, np.array(rgba))


def _contact() -> ProximityProperties:
    touching = ProximityProperties()
    friction = CoulombFriction(_PEN_FRICTION, _PEN_FRICTION)
    AddContactMaterial(dissipation=1.0, friction=friction, properties=touching)
    return touching


def _add_rig(
    plant: MultibodyPlant, arm: ModelInstanceIndex, tablet: TabletConfig, truth: TabletTruth
) -> ModelInstanceIndex:
    """Add plate and camera, welded to the flange, and the pen, which yields along z_F against its spring."""
    pen = tablet.pen
    rig = plant.AddModelInstance("pen_rig")
    inertia = SpatialInertia(0.4, np.zeros(3), UnitInertia.SolidBox(0.14, 0.07, 0.03))
    plate = plant.AddRigidBody("rig_plate", rig, inertia)
    plant.WeldFrames(plant.GetFrameByName("flange", arm), plate.body_frame())
    _show(plant, plate, RigidTransform([0.03, 0.0, 0.006]), Box(0.14, 0.07, 0.012), "rig_plate", DARK)
    _show(plant, plate, truth.X_FC @ RigidTransform([0.0, 0.0, -0.016]), _CAMERA_BOX, "wrist_camera_body", STEEL)
    X_FP = RigidTransform(truth.p_FP)
    rest = plant.AddFrame(FixedOffsetFrame("pen_rest", plate.body_frame(), X_FP, rig))
    nib = plant.AddRigidBody("pen", rig, SpatialInertia(_PEN_MASS_KG, np.zeros(3), UnitInertia.SolidSphere(0.02)))
    joint = plant.AddJoint(PrismaticJoint("pen", rest, nib.body_frame(), [0.0, 0.0, 1.0], -0.012, 0.0005, 0.0))
    spring = plant.AddJointActuator("pen", joint)
    spring.set_controller_gains(PdControllerGains(p=pen.stiffness_N_per_m, d=_PEN_DAMPING))
    radius, length = 1e-3 * pen.radius_mm, float(truth.p_FP[2]) - 0.012
    _show(plant, nib, RigidTransform([0.0, 0.0, -0.5 * length - 0.004]), Cylinder(0.0045, length - 0.008), "pen", DARK)
    _show(plant, nib, RigidTransform([0.0, 0.0, -0.002]), Cylinder(radius, 0.004), "nib_body", STEEL)
    soft = _contact()
    AddCompliantHydroelasticProperties(
        resolution_hint=radius / _NIB_FACETS, hydroelastic_modulus=_PEN_MODULUS_PA, properties=soft
    )
    plant.RegisterCollisionGeometry(nib, RigidTransform(), Sphere(radius), NIB, soft)
    return rig


def _add_tablet(plant: MultibodyPlant, tablet: TabletConfig, X_BT: RigidTransform) -> None:
    """Add the tablet: its page as visual geometry and its glass as contact geometry. Frame: the world is the base B."""
    ground = plant.world_body()
    far = tablet.landmarks_m().max(axis=0)
    width, height = far + 2e-3 * tablet.margin_mm
    middle = X_BT @ RigidTransform(np.r_[0.5 * far, 0.0])
    slab = Box(width + 2.0 * _FRAME_M, height + 2.0 * _FRAME_M, _THICK_M)
    _show(plant, ground, middle @ RigidTransform([0.0, 0.0, 0.5 * _THICK_M + 0.0005]), slab, "tablet", DARK)
    facing = RotationMatrix.MakeXRotation(np.pi)  # the board faces along its z; the tablet's z points into it
    board = textured_board("page", float(width), float(height), page_picture(tablet))
    page = GeometryInstance(middle @ RigidTransform(facing), board, "page")
    page.set_perception_properties(PerceptionProperties())
    page.set_illustration_properties(IllustrationProperties())
    plant.RegisterVisualGeometry(ground, page)
    hard = _contact()
    AddRigidHydroelasticProperties(properties=hard)
    plant.RegisterCollisionGeometry(ground, middle @ RigidTransform([0.0, 0.0, 0.5 * _THICK_M]), slab, GLASS, hard)
