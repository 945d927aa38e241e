"""Adds the flange and the welding tool to a plant: bodies, visual geometry and contact geometry."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    Box,
    Capsule,
    Cylinder,
    GeometryInstance,
    IllustrationProperties,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    ProximityProperties,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)

from weldcal.calibration.planning.clearance import Surroundings
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import ToolShape, WeldingTool
from weldcal.models.tools.enclosing import shape_mesh
from weldcal.systems.viewer.scene import textured_board
from weldcal.welding.finger.deformation import TagModel, tag_cells

STEEL = (0.62, 0.64, 0.67, 1.0)
DARK = (0.16, 0.18, 0.21, 1.0)
COPPER = (0.80, 0.45, 0.20, 1.0)
SOFT = (0.18, 0.42, 0.62, 1.0)
TABLE = (0.36, 0.38, 0.40, 1.0)
SURROUNDINGS = (0.55, 0.50, 0.42, 1.0)
COLOURS = {"dark": DARK, "steel": STEEL, "copper": COPPER, "soft": SOFT, "white": (1.0, 1.0, 1.0, 1.0)}
CELL_PX = 32  # texels of a tag cell: more than those of the camera's picture of it
# A camera pixel integrates light over its area through a lens; a renderer samples one point of it. The blur of lens and
# pixel, in texels, is applied to the print. Without it, edges parallel to the pixel rows would be off by a tenth of a
# pixel.
BLUR_TEXELS = 1.2
TAG_PLATE_DEPTH_M = 0.00005  # of its face below the print
TIP_FRICTION = 0.2  # soft tip on steel
# The contact model approximates a sphere by an inscribed polyhedron with this share of its volume (at a resolution of
# half the radius). The requested sphere is larger by the same factor, so that the polyhedron has the tip's volume.
CONTACT_MESH_VOLUME = 0.9114


def mesh_shape(mesh: TriMesh, name: str) -> Mesh:
    """Convert a TriMesh to an in-memory Drake Mesh."""
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(contents=mesh.to_obj(), extension=".obj", filename_hint=name)))


def drake_shape(shape: ToolShape) -> Shape:
    """Return a tool's shape for Drake."""
    if shape.kind == "mesh":
        return mesh_shape(shape_mesh(shape), "tool.obj")
    kinds: dict[str, type[Shape]] = {"box": Box, "cylinder": Cylinder, "capsule": Capsule, "sphere": Sphere}
    return kinds[shape.kind](*shape.size)


def show(
    plant: MultibodyPlant, body: RigidBody, X: RigidTransform, shape: Shape, name: str, rgba: tuple[float, ...]
) -> None:
    """Register visual geometry on a body, for Meshcat and for rendered images."""
    plant.RegisterVisualGeometry(body, X, shape, name, np.array(rgba))


def add_surroundings(plant: MultibodyPlant, surroundings: Surroundings) -> None:
    """Add the cell's surroundings to the world as visual geometry."""
    for k, obstacle in enumerate(surroundings.obstacles):
        shape = mesh_shape(obstacle.mesh, f"surroundings_{k}.obj")
        show(plant, plant.world_body(), RigidTransform(), shape, f"surroundings_{k}", SURROUNDINGS)


def add_flange(plant: MultibodyPlant, arm: ModelInstanceIndex, flange: str) -> None:
    """Add the ISO 9409-1 flange: its face in the flange frame's x-y plane, its back inside the wrist."""
    body = plant.GetBodyByName("flange", arm)
    shape = mesh_shape(flange_mesh(get_flange(flange), thickness_m=0.012), "flange.obj")
    show(plant, body, RigidTransform(), shape, "iso_flange", STEEL)


def tool_tag(tool: WeldingTool) -> TagModel:
    """Return the tag that the tool carries."""
    return TagModel(dictionary=tool.tag_dictionary, id=tool.tag_id, size_m=tool.tag_size_m)


def printed_tag(tag: TagModel) -> tuple[NDArray[np.uint8], float]:
    """Return the print (n, n) of a tag with a white margin of one cell, blurred as by a lens, and its side in m."""
    cells = cv2.copyMakeBorder(255 * tag_cells(tag).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=255)
    sharp = np.maximum(np.kron(cells, np.ones((CELL_PX, CELL_PX), dtype=np.uint8)), 5)
    print_ = np.asarray(cv2.GaussianBlur(sharp, (0, 0), BLUR_TEXELS), dtype=np.uint8)
    return print_, tag.size_m * cells.shape[0] / (cells.shape[0] - 2)


def _print_tag(plant: MultibodyPlant, body: RigidBody, X: RigidTransform, tag: TagModel) -> None:
    """Add the tag's print, in the marker frame (x right, y up, z out of the print)."""
    print_, size = printed_tag(tag)
    geometry = GeometryInstance(X, textured_board("tag", size, size, print_), "tag_print")
    geometry.set_perception_properties(PerceptionProperties())
    geometry.set_illustration_properties(IllustrationProperties())
    plant.RegisterVisualGeometry(body, geometry)


def add_tool(
    plant: MultibodyPlant, arm: ModelInstanceIndex, tool: WeldingTool, contact_hint_m: float
) -> ModelInstanceIndex:
    """Add the tool's bodies and its ring, welded to the flange, and the soft tip on three sprung prismatic joints."""
    instance = plant.AddModelInstance("tool")
    flange_frame = plant.GetFrameByName("flange", arm)
    middle = np.array(tool.centre_of_mass_m)
    inertia = SpatialInertia(
        tool.mass_kg, middle, UnitInertia.SolidBox(0.25, 0.08, 0.12).ShiftFromCenterOfMass(-middle)
    )
    plate = plant.AddRigidBody("tool_plate", instance, inertia)
    plant.WeldFrames(flange_frame, plate.body_frame())
    if tool.ring is not None:
        ring = flange_mesh(tool.ring, thickness_m=tool.ring_height_m)
        show(plant, plate, tool.X_FR, mesh_shape(ring, "ring.obj"), "flange_like_ring", STEEL)
    for body_shape in tool.drawn():
        show(plant, plate, body_shape.place.pose, drake_shape(body_shape), body_shape.name, COLOURS[body_shape.colour])

    # Three prismatic joints in series carry the tip; the springs are implicit PD controllers, stable at 2 ms with a
    # mass of grams.
    parent = plant.AddFrame(_fixed_offset(plant, "tip_rest", plate, tool.X_FT))
    small = SpatialInertia(tool.tip_mass_kg / 3, np.zeros(3), UnitInertia.SolidSphere(0.01))
    body = plate
    for axis, name in enumerate("xyz"):
        body = plant.AddRigidBody(f"tip_{name}", instance, small)
        direction = np.eye(3)[axis]
        joint = plant.AddJoint(PrismaticJoint(f"tip_{name}", parent, body.body_frame(), direction, -0.012, 0.012, 0.0))
        actuator = plant.AddJointActuator(f"tip_{name}", joint)
        stiffness = tool.axial_stiffness_N_per_m if name == "z" else tool.lateral_stiffness_N_per_m
        stiffness *= 1.0 if tool.memory is None else 1.0 + tool.memory.relaxing
        actuator.set_controller_gains(PdControllerGains(p=stiffness, d=tool.damping_N_s_per_m))
        parent = body.body_frame()

    X_TM = tool.X_TM
    p_TM = X_TM.translation()
    radius, reach = tool.tip_radius_m, float(p_TM[2])
    show(plant, body, RigidTransform(), Sphere(radius), "tip", SOFT)
    show(
        plant,
        body,
        RigidTransform([0.0, 0.0, reach / 2 - 0.003]),
        Cylinder(tool.finger_radius_m, reach - 0.006),
        "finger",
        SOFT,
    )
    X_TMembrane = RigidTransform(X_TM.rotation(), [p_TM[0], p_TM[1], reach - 0.0015])
    show(plant, body, X_TMembrane, Cylinder(tool.membrane_radius_m, 0.002), "membrane", SOFT)
    plate = Box(tool.tag_plate_m, tool.tag_plate_m, 0.0005)
    X_TPlate = X_TM @ RigidTransform([0.0, 0.0, -0.00025 - TAG_PLATE_DEPTH_M])
    show(plant, body, X_TPlate, plate, "tag_white", (1.0, 1.0, 1.0, 1.0))
    _print_tag(plant, body, X_TM, tool_tag(tool))
    contact = ProximityProperties()
    AddContactMaterial(dissipation=1.0, friction=CoulombFriction(TIP_FRICTION, TIP_FRICTION), properties=contact)
    AddCompliantHydroelasticProperties(
        resolution_hint=contact_hint_m, hydroelastic_modulus=tool.tip_modulus_Pa, properties=contact
    )
    rounded = Sphere(radius * CONTACT_MESH_VOLUME ** (-1.0 / 3.0))
    plant.RegisterCollisionGeometry(body, RigidTransform(), rounded, "tip_contact", contact)
    return instance


def _fixed_offset(plant: MultibodyPlant, name: str, body: RigidBody, X: RigidTransform) -> FixedOffsetFrame:
    return FixedOffsetFrame(name, body.body_frame(), X, body.model_instance())
