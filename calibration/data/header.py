"""Schema of dataset.yaml: the contents of a calibration dataset and its units."""

# no `from __future__ import annotations` here: pydrake's YAML reader needs the field types themselves, not their names

from dataclasses import asdict, dataclass, field
from typing import Any

from pydrake.math import RigidTransform


@dataclass
class Units:
    """Length units of the files: ``m``, ``mm`` or ``auto`` (by their size).

    Flange poses and clouds must then lie 10 mm to 10 m away (median).
    """

    clouds: str = "m"
    poses: str = "m"


@dataclass
class Feature:
    """Pose of the flange-like feature in the flange frame: position m and quaternion wxyz.

    Identity for a bare flange.
    """

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    wxyz: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])


@dataclass
class ScannerGuess:
    """Approximate pose X_BC of the scanner.

    Position m, quaternion wxyz, and the largest error of the feature it causes, m.
    """

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    wxyz: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])
    radius_m: float = 0.06


@dataclass
class SecondRobot:
    """The second robot of a co-manipulation and the approximate pose X_BD of its base in the first one's base.

    Lengths in m, quaternion wxyz.
    """

    robot: str = "ur10e"
    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    wxyz: list[float] = field(default_factory=lambda: [1.0, 0.0, 0.0, 0.0])


@dataclass
class DepthCamera:
    """Intrinsics of depth images, pixels; the centre of the first pixel is 0, 0."""

    fx: float = 0.0
    fy: float = 0.0
    cx: float = 0.0
    cy: float = 0.0


@dataclass(kw_only=True)
class PoseForm:
    """How the poses are written, where it is not x,y,z,qw,qx,qy,qz.

    ``file`` (a file or folder beside dataset.yaml), ``rotation`` (a notation by name), ``angles`` (rad or deg),
    ``frame`` (flange_in_base, or base_in_flange for the inverse), ``tcp`` (the controller's TCP x,y,z,rx,ry,rz in m and
    rad where the poses are the TCP's), and of a ROS recording the names of the frames and topics.
    """

    file: str = ""
    rotation: str = ""
    angles: str = ""
    frame: str = "flange_in_base"
    tcp: list[float] = field(default_factory=list)
    base_frame: str = ""
    flange_frame: str = ""
    topic: str = ""
    cloud_topic: str = ""


@dataclass(kw_only=True)
class DatasetHeader:
    """Contents of dataset.yaml.

    ``mode``: static (a scan at each pose) or motion (scans while the arm moves). ``intrinsics`` and ``depth_scale``
    (metres of one unit) of depth images; ``viewpoint``: what VIEWPOINT of PCD files means. Of a scanner that an arm
    carries: ``scanner_guess`` is its pose on its carrier. ``scanner_link`` the link that carries it (eye_on_arm),
    ``second_robot`` the arm that shows its flange (co_manipulation), ``arm_error_mm`` the rms error of the flange's
    reported position.
    """

    schema: int = 0
    robot: str = ""
    flange: str = ""
    scanner: str = ""
    configuration: str = ""
    units: Units = field(default_factory=Units)
    note: str = ""
    feature_in_flange: Feature = field(default_factory=Feature)
    scanner_guess: ScannerGuess | None = None
    mode: str = "static"
    poses: PoseForm | None = None
    intrinsics: DepthCamera | None = None
    depth_scale: float = 0.0
    viewpoint: str = ""
    scanner_link: str = ""
    second_robot: SecondRobot | None = None
    arm_error_mm: float = 0.4


def placed(X: RigidTransform) -> dict[str, list[float]]:
    """Return a pose as a header has it: xyz (m) and wxyz."""
    return {"xyz": X.translation().tolist(), "wxyz": X.rotation().ToQuaternion().wxyz().tolist()}


def without_cloud_form(header: DatasetHeader) -> dict[str, Any]:
    """Return the header as a document of plain values for clouds that are written in metres, in the sensor's frame."""
    return {k: v for k, v in asdict(header).items() if k not in ("intrinsics", "depth_scale", "viewpoint")}
