"""Keys of a tool file, in millimetres and degrees; poses are in the flange frame F (z out of the flange)."""

from dataclasses import dataclass, field

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
    standard: str = ""  # its dimensions by name (tool-ring-63, iso9409-1-50-4-m6 ...); empty: outer_mm and bore_mm
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


@dataclass
class TorchPart:
    """The torch."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)  # the wire point, where the arc burns
    axis: Triple = (0.0, 0.0, 1.0)  # direction of the wire, towards the work


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
    """A body of the tool: drawn, seen by the scanner, and kept clear of the table and of the line of sight. One kind of a shape."""

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
