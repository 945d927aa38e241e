"""Reads a tool file and checks that such a tool can exist."""

import dataclasses as dc
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.documents import read_document, read_part
from weldcal.models.errors import InputError
from weldcal.models.flanges import FlangeStandard, flange_ring, get_flange, is_part_file
from weldcal.models.tool import LAST_LINK, R_FLIPPED, FingerCamera, Placed, ToolShape, WeldingTool
from weldcal.models.tools.enclosing import enclosing_capsule
from weldcal.models.tools.finger_file import FingerFile, read_finger_file

if TYPE_CHECKING:
    from weldcal.models.tools.elastomers import Elastomer

Triple = tuple[float, float, float]


@dataclass
class RingPart:
    """The flange-like ring that the scanner measures. Without this part the scanner measures the arm's bare flange."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)  # middle of the ring's face
    rpy_deg: Triple = (
        180.0,
        0.0,
        0.0,
    )  # its z out of the face; 180, 0, 0 looks back along the flange, at a scanner above
    # its dimensions by name (tool-ring-63, iso9409-1-50-4-m6 ...), or its STL or STEP file; empty: outer_mm and bore_mm
    standard: str = ""
    outer_mm: float = 0.0  # outer diameter
    bore_mm: float = 0.0  # diameter of the bore
    thickness_mm: float = 8.0  # of the ring as it is drawn


@dataclass(kw_only=True)
class TipPart:
    """The soft tip: a ball on three springs."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)  # the ball's centre at rest
    axis: Triple = (0.0, 0.0, 1.0)  # direction in F in which the finger points, towards the work
    radius_mm: float = 2.5  # of the ball
    modulus_MPa: float = 10.0  # how soft the ball is (hydroelastic modulus)
    lateral_stiffness_N_per_mm: float = 0.6  # across the finger
    axial_stiffness_N_per_mm: float = 0.3  # along the finger
    damping_N_s_per_m: float = 3.0
    mass_kg: float = 0.005  # of what moves with the tip
    finger_radius_mm: float = 2.2  # of the drawn rod between tag and ball
    material: str = ""  # tpu_85a, tpu_95a, silicone: its creep and its loss; empty: springs without memory
    relaxation_s: float | None = None  # of the simulated tip, in place of the material's, as are the two shares
    creep_share: float | None = None  # of the force of a fast press that relaxes
    loss_share: float | None = None  # of the work of a slow press that does not return


@dataclass
class TorchPart:
    """The torch."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)  # the wire point, where the arc burns
    axis: Triple = (0.0, 0.0, 1.0)  # direction of the wire, towards the work
    stick_out_mm: float | None = None  # from the nozzle's end to the wire point
    nozzle_mm: float = 18.0  # outer diameter of the nozzle


@dataclass
class FingerCameraPart:
    """The camera that looks at the tag: its pose (OpenCV: z along the view, x to the right), and its pictures."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    width: int = 400  # px
    height: int = 300
    focal_px: float = 450.0
    calibration: str = (
        ""  # finger.yaml of weldcal finger calibrate: intrinsics and the tag's measured side come from it
    )


@dataclass(kw_only=True)
class TagPart:
    """The tag that moves with the tip."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)  # its middle while the tip is free
    rpy_deg: Triple = (180.0, 0.0, 0.0)  # x to the right of the print, y up, z out of it
    dictionary: str = "4X4_50"
    id: int = 0
    size_mm: float = 10.0  # side of the black square
    plate_mm: float = 16.0  # side of the white plate under it
    membrane_mm: float = 52.0  # diameter of the soft disc that carries it


@dataclass(kw_only=True)
class ShapePart:
    """Describe a body of the tool: drawn, visible to the scanner, clear of the table and of the line of sight.

    One kind of a shape.
    """

    name: str = ""
    box_mm: Triple | None = None  # along x, y, z of its own frame
    cylinder_mm: tuple[float, float] | None = None  # radius, length along its z
    capsule_mm: tuple[float, float] | None = None  # radius, length along its z between the middles of its ends
    sphere_mm: float | None = None  # radius
    mesh: str = ""  # an STL, OBJ or PLY file
    units: str = "mm"  # of the mesh: mm, cm, m or inch
    xyz_mm: Triple = (0.0, 0.0, 0.0)  # its middle; of a mesh: its origin
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    colour: str = "dark"  # dark, steel, copper, soft or white


@dataclass
class CapsulePart:
    """All points within a distance of a line."""

    from_mm: Triple = (0.0, 0.0, 0.0)
    to_mm: Triple = (0.0, 0.0, 0.0)
    radius_mm: float = 10.0


@dataclass(kw_only=True)
class ToolPart:
    """A tool file."""

    name: str = ""
    mass_kg: float = 1.0  # of the whole tool
    centre_of_gravity_mm: Triple = (0.0, 0.0, 50.0)
    ring: RingPart | None = None
    tip: TipPart = field(default_factory=TipPart)
    torch: TorchPart = field(default_factory=TorchPart)
    finger_camera: FingerCameraPart = field(default_factory=FingerCameraPart)
    tag: TagPart = field(default_factory=TagPart)
    shapes: list[ShapePart] = field(default_factory=list)
    keep_clear: list[CapsulePart] = field(
        default_factory=list
    )  # empty: capsules about the shapes, the finger and the torch


REQUIRED = ("mass_kg", "centre_of_gravity_mm", "tip", "torch", "finger_camera", "tag")
"""Keys that a tool file must have; of tip, torch, finger_camera and tag, xyz_mm."""


POSITIVE = (
    *("mass_kg", "tip.radius_mm", "tip.modulus_MPa", "tip.lateral_stiffness_N_per_mm", "tip.axial_stiffness_N_per_mm"),
    *("tip.damping_N_s_per_m", "tip.mass_kg", "tip.finger_radius_mm", "tag.size_mm", "tag.plate_mm"),
    *("tag.membrane_mm", "finger_camera.focal_px", "finger_camera.width", "finger_camera.height"),
)
LEAST_CHORD_M = 0.010  # the servo steers by the line from torch to tip
LEAST_RELAXATION_S = 0.02  # ten steps of the simulated plant
MOST_SHARE = 0.6  # of creep or loss: the friction of the simulated tip would chatter beyond
WELDING = Path(__file__).resolve().parent / "welding.yaml"
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
COLOURS = ("dark", "steel", "copper", "soft", "white")
_SIZES = ("box_mm", "cylinder_mm", "capsule_mm", "sphere_mm", "mesh")


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class LoadedTool:
    """A tool of a file.

    The tool, its camera's picture size and focal length, its finger calibration's path ("" without), and the pose X_FW
    of the torch (z along the wire).
    """

    name: str
    file: Path
    tool: WeldingTool
    camera: FingerCamera
    calibration: str
    finger: FingerFile | None
    p_FW: Array
    torch_axis: Array


def tool_file(name: Path) -> Path:
    """Return the file of a tool that is given by its path, or by the name of one that weldcal has, such as tip_1p5."""
    own = WELDING.parent / f"{name}.yaml"
    return own if not name.is_file() and own.is_file() else name


def load_tool(path: Path) -> LoadedTool:
    """Return the tool of a file; files that it names are relative to it.

    Raises:
        InputError: the file cannot be read, has an unknown key, or describes a tool that cannot be.
    """
    stat = path.stat() if path.is_file() else None
    return _load(path.resolve(), None if stat is None else stat.st_mtime_ns)


@lru_cache(maxsize=8)
def _load(path: Path, changed: int | None) -> LoadedTool:
    if changed is None:
        raise InputError(f"There is no tool file '{path}': weldcal tool check FILE says how one is read.")
    document = read_document(path)
    part = read_part(ToolPart, document, path.name)
    for key in REQUIRED:
        if key not in document:
            raise InputError(f"'{path.name}' lacks {key}: see docs/tool.md for a complete tool.")
        if isinstance(document[key], dict) and "xyz_mm" not in document[key]:
            raise InputError(f"'{path.name}' lacks {key}.xyz_mm, its place in the flange frame.")
    _check_sizes(path.name, part)
    R_FT, chord, height = _tip_frame(path.name, part)
    finger, calibration = None, part.finger_camera.calibration
    if calibration:
        calibration = str(path.parent / calibration)
        finger = read_finger_file(Path(calibration))
    shapes = tuple(_shape(path, i, s) for i, s in enumerate(part.shapes))
    tip, tag, camera = part.tip, part.tag, part.finger_camera
    rpy = RollPitchYaw(R_FT).vector()
    tool = WeldingTool(
        tip_radius_m=tip.radius_mm / 1e3,
        tip_modulus_Pa=tip.modulus_MPa * 1e6,
        tip_mass_kg=tip.mass_kg,
        lateral_stiffness_N_per_m=tip.lateral_stiffness_N_per_mm * 1e3,
        axial_stiffness_N_per_m=tip.axial_stiffness_N_per_mm * 1e3,
        damping_N_s_per_m=tip.damping_N_s_per_m,
        memory=_memory(path.name, tip),
        tip_reach_m=tip.xyz_mm[2] / 1e3,
        tag_reach_m=tag.xyz_mm[2] / 1e3,
        tag_size_m=tag.size_mm / 1e3 if finger is None or finger.tag_size_m is None else finger.tag_size_m,
        tag_dictionary=tag.dictionary,
        tag_id=tag.id,
        chord_m=chord,
        torch_height_m=height,
        torch_tilt_rad=_tilt(R_FT, part.torch.axis),
        stick_out_m=None if part.torch.stick_out_mm is None else part.torch.stick_out_mm / 1e3,
        nozzle_radius_m=0.5 * part.torch.nozzle_mm / 1e3,
        mass_kg=part.mass_kg,
        centre_of_mass_m=_metres(part.centre_of_gravity_mm),
        ring=None if part.ring is None else _ring(path, part.ring),
        ring_height_m=0.008 if part.ring is None else part.ring.thickness_mm / 1e3,
        finger_radius_m=tip.finger_radius_mm / 1e3,
        membrane_radius_m=0.5 * tag.membrane_mm / 1e3,
        tag_plate_m=tag.plate_mm / 1e3,
        ring_pose=None if part.ring is None else _ring_pose(path, part.ring),
        tip_pose=Placed(_metres(tip.xyz_mm), (float(rpy[0]), float(rpy[1]), float(rpy[2]))),
        camera_pose=_placed(camera.xyz_mm, camera.rpy_deg),
        tag_pose=_placed(tag.xyz_mm, tag.rpy_deg),
        shapes=shapes,
        keep_clear=_keep_clear(part, shapes),
    )
    pictures = FingerCamera(camera.width, camera.height, camera.focal_px)
    if finger is not None:
        pictures = FingerCamera(finger.width, finger.height, finger.focal_px)
    loaded = LoadedTool(
        name=part.name or path.stem,
        file=path,
        tool=tool,
        camera=pictures,
        calibration=calibration,
        finger=finger,
        p_FW=np.array(_metres(part.torch.xyz_mm)),
        torch_axis=_unit(part.torch.axis),
    )
    check_sight(loaded)
    return loaded


def check_sight(loaded: LoadedTool) -> Array:
    """Pixels (4, 2) of the resting tag's corners in the finger camera.

    Raises:
        InputError: the camera does not see the tag.
    """
    tool, camera, file = loaded.tool, loaded.camera, loaded.file.name
    X_KM = tool.X_KM_rest
    facing = float(-X_KM.rotation().matrix()[2, 2])
    if X_KM.translation()[2] <= 0.0:
        raise InputError(
            f"'{file}': the tag is behind the finger camera: check finger_camera.rpy_deg (z along the view) and"
            " tag.xyz_mm."
        )
    if facing < np.cos(np.deg2rad(60.0)):
        raise InputError(
            f"'{file}': the tag does not face the finger camera. The tag's z axis must point at the camera, and it is "
            f"{np.rad2deg(np.arccos(np.clip(facing, -1.0, 1.0))):.0f} deg off: correct tag.rpy_deg."
        )
    half = 0.5 * tool.tag_size_m * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    p_K = half @ X_KM.rotation().matrix().T + X_KM.translation()
    pixels: Array = (p_K @ camera.camera_matrix.T)[:, :2] / p_K[:, 2:]
    if pixels.min() < 0.0 or (pixels > [camera.width - 1, camera.height - 1]).any():
        raise InputError(
            f"'{file}': the tag is not whole in the finger camera's picture of {camera.width} x {camera.height} px:"
            " move the camera back, make the tag smaller, or correct focal_px and the poses."
        )
    return pixels


def _metres(mm: Triple) -> Triple:
    x, y, z = (v / 1e3 for v in mm)
    return x, y, z


def _unit(axis: Triple) -> Array:
    return np.asarray(np.array(axis) / np.linalg.norm(axis), dtype=np.float64)


def _placed(xyz_mm: Triple, rpy_deg: Triple) -> Placed:
    r, p, y = (float(np.deg2rad(v)) for v in rpy_deg)
    return Placed(_metres(xyz_mm), (r, p, y))


def _check_sizes(file: str, part: ToolPart) -> None:
    for key in POSITIVE:
        value = attrgetter(key)(part)
        if value <= 0.0:
            raise InputError(f"'{file}': {key} must be positive, and it is {value:g}.")
    for key, axis in (("tip.axis", part.tip.axis), ("torch.axis", part.torch.axis)):
        if np.linalg.norm(axis) < 1e-6:
            raise InputError(f"'{file}': {key} must be a direction, not {list(axis)}.")
    if part.tip.mass_kg >= part.mass_kg:
        raise InputError(
            f"'{file}': tip.mass_kg is what moves with the tip, in kg, and less than mass_kg of the whole tool."
        )
    longest = max(np.linalg.norm(p.xyz_mm) for p in (part.tip, part.torch, part.finger_camera, part.tag))
    if longest > 2000.0:
        raise InputError(
            f"'{file}': a point of the tool is {longest:.0f} mm from the flange; give millimetres in the flange frame."
        )


def _memory(file: str, tip: TipPart) -> "Elastomer | None":
    """Return what the tip remembers, None where the file states nothing of it."""
    keys = ("relaxation_s", "creep_share", "loss_share")
    given = {key: value for key in keys if (value := getattr(tip, key)) is not None}
    if not tip.material and not given:
        return None
    from weldcal.models.tools.elastomers import MATERIALS  # only here: few files describe it so far

    if tip.material and tip.material not in MATERIALS:
        raise InputError(f"'{file}': tip.material must be one of {', '.join(MATERIALS)}, not '{tip.material}'.")
    if not tip.material and len(given) < len(keys):
        raise InputError(f"'{file}': tip needs {', '.join(keys)} together, or a material that gives the others.")
    found = dc.replace(MATERIALS.get(tip.material, MATERIALS["silicone"]), **given)
    if not found.relaxation_s >= LEAST_RELAXATION_S:
        raise InputError(f"'{file}': tip.relaxation_s must be {LEAST_RELAXATION_S:g} s or more.")
    for key in keys[1:]:
        if not 0.0 <= getattr(found, key) <= MOST_SHARE:
            raise InputError(f"'{file}': tip.{key} is a share from 0 to {MOST_SHARE:g}, not {getattr(found, key):g}.")
    return found


def _tip_frame(file: str, part: ToolPart) -> tuple[RotationMatrix, float, float]:
    """Compute R_FT, and the torch point (-chord, 0, height) in T, m.

    ``z_T`` points against the finger's axis, x_T from the torch to the tip.
    """
    z = -_unit(part.tip.axis)
    to_tip = (np.array(part.tip.xyz_mm) - np.array(part.torch.xyz_mm)) / 1e3
    level = to_tip - (to_tip @ z) * z
    chord = round(float(np.linalg.norm(level)), 12)
    if chord < LEAST_CHORD_M:
        raise InputError(
            f"'{file}': the torch must trail the tip by {1e3 * LEAST_CHORD_M:.0f} mm or more across the finger, and it"
            f" is {1e3 * chord:.1f} mm away: correct torch.xyz_mm or tip.xyz_mm."
        )
    x = level / np.linalg.norm(level)
    R = RotationMatrix(np.column_stack([x, np.cross(z, x), z]))
    if np.abs(R.matrix() - R_FLIPPED.matrix()).max() < 1e-12:
        R = R_FLIPPED
    return R, chord, round(float(-(to_tip @ z)), 12)


def _tilt(R_FT: RotationMatrix, axis: Triple) -> float:
    """How far the wire's axis leans back from the tip's in the plane of tip and torch, rad."""
    x, _, z = R_FT.matrix().T @ _unit(axis)
    return round(float(np.arctan2(x, -z)), 4)


def _ring_pose(path: Path, part: RingPart) -> Placed:
    """Return the ring's pose; of a part's file the stated pose is that of the file's frame."""
    placed = _placed(part.xyz_mm, part.rpy_deg)
    if not is_part_file(part.standard):
        return placed
    from weldcal.models.tools.own_ring import own_ring  # reads parts: few tools need it

    X_FR = placed.pose @ own_ring(path.parent / part.standard).X_SR
    x, y, z = X_FR.translation().tolist()
    roll, pitch, yaw = RollPitchYaw(X_FR.rotation()).vector().tolist()
    return Placed((x, y, z), (roll, pitch, yaw))


def _ring(path: Path, part: RingPart) -> FlangeStandard:
    file = path.name
    if is_part_file(part.standard):
        from weldcal.models.tools.own_ring import own_ring

        return get_flange(own_ring(path.parent / part.standard).name)
    if part.standard:
        return get_flange(part.standard)
    if not 0.0 < part.bore_mm < part.outer_mm:
        raise InputError(f"'{file}': ring needs a standard, or outer_mm and a smaller bore_mm.")
    return flange_ring(part.outer_mm / 1e3, part.bore_mm / 1e3, designation=f"ring-{part.outer_mm:g}")


def _shape(path: Path, i: int, part: ShapePart) -> ToolShape:
    place = f"'{path.name}': shapes[{i}]{f' ({part.name})' if part.name else ''}"
    given = [key for key in _SIZES if getattr(part, key)]
    if len(given) != 1:
        raise InputError(f"{place} must have one of {', '.join(_SIZES)}.")
    if part.colour not in COLOURS:
        raise InputError(f"{place}: colour must be one of {', '.join(COLOURS)}, not '{part.colour}'.")
    if part.units not in UNITS_M:
        raise InputError(f"{place}: units must be one of {', '.join(UNITS_M)}, not '{part.units}'.")
    kind, value = given[0].removesuffix("_mm"), getattr(part, given[0])
    name, where = part.name or f"{kind}_{i}", _placed(part.xyz_mm, part.rpy_deg)
    if kind == "mesh":
        file = path.parent / part.mesh
        if not file.is_file():
            raise InputError(f"{place}: there is no file '{file}'.")
        return ToolShape(
            name=name, kind=kind, size=(), place=where, colour=part.colour, mesh=str(file), unit_m=UNITS_M[part.units]
        )
    size = tuple(v / 1e3 for v in (value if isinstance(value, tuple) else (value,)))
    if min(size) <= 0.0:
        raise InputError(f"{place}: {given[0]} must be positive.")
    return ToolShape(name=name, kind=kind, size=size, place=where, colour=part.colour)


def _keep_clear(part: ToolPart, shapes: tuple[ToolShape, ...]) -> tuple[Capsule, ...]:
    """Return the file's capsules, or capsules about the shapes, the finger and the wire."""
    if part.keep_clear:
        return tuple(
            Capsule(LAST_LINK, np.array(_metres(c.from_mm)), np.array(_metres(c.to_mm)), c.radius_mm / 1e3)
            for c in part.keep_clear
        )
    tag, tip, torch = (np.array(_metres(p.xyz_mm)) for p in (part.tag, part.tip, part.torch))
    back = torch - 0.02 * _unit(part.torch.axis)
    own = [
        Capsule(LAST_LINK, tag, tip, max(part.tip.radius_mm, part.tip.finger_radius_mm) / 1e3 + 0.001),
        Capsule(LAST_LINK, tag, tag, 0.5 * part.tag.membrane_mm / 1e3),
        Capsule(LAST_LINK, back, torch, 0.003),
    ]
    return (*(enclosing_capsule(shape) for shape in shapes), *own)
