"""An arm of revolute joints: its link transforms, forward kinematics and Jacobians, and Universal Robots' numbers.

Frames: B robot base as the controller means it (ROS `base_link` turned by pi about z), L_i the six link frames, F the
flange (DH frame 6, z out of the flange), which is the last link frame. A link transform is the pose of link i's joint
in link i-1 at zero angle, and the chain is their plain product: X_BF = prod_i X_{i-1,i}(0) RotZ(q_i). A robot's
factory calibration has the same schema as the nominal numbers, so nothing else changes when one is given.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from weldcal.models.arrays import Array
from weldcal.models.documents import as_number, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER

if TYPE_CHECKING:
    from pydrake.math import RigidTransform

LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
LINK_NAMES = ("base", *(f"{link}_link" for link in LINKS))
JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)

# Factory calibrations move the flange by millimetres; a file that moves it by more is another arm's or in other units.
MAX_CALIBRATION_SHIFT_M = 0.05
POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class DenavitHartenberg:
    """Nominal Denavit-Hartenberg lengths of a UR arm (m); alpha = pi/2, 0, 0, pi/2, -pi/2, 0, all other terms 0."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float


@dataclass(frozen=True)
class Housings:
    """Radii (m) of the joints' housings and of the two tubes, for the drawn body and its capsules."""

    shoulder: float
    elbow: float
    wrist: float
    upper_tube: float
    forearm_tube: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """n joints in a row: ``stack`` (n, 4, 4) is the pose of each joint in its parent at zero angle, its z the axis.

    ``X_LF`` the flange in the last joint's frame; limits (n,) rad and rad/s. up (3,) is the unit vector against gravity
    in B: +z of an arm that stands. ``file`` is the URDF that the arm is read from.
    """

    name: str
    joint_names: tuple[str, ...]
    stack: Array
    X_LF: Array = field(default_factory=lambda: _frozen(np.eye(4)))
    position_lower: Array
    position_upper: Array
    velocity_limit: Array
    up: Array = field(default_factory=lambda: _frozen([0.0, 0.0, 1.0]))
    file: Path | None = None

    @property
    def n(self) -> int:
        """How many joints."""
        return len(self.stack)


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmModel(Chain):
    """One arm of Universal Robots, a chain with bodies and masses. Arrays are read-only; link order is `link_names`.

    Link 0 is the base. Limits are (6,) in rad/s^2, Nm (the acceleration limits are a model choice, see
    joint_limits.yaml). masses (6,) kg,
    centers_of_mass (6, 3) m in the link frames, inertias (6, 3, 3) kg m^2 about the centre of mass in link axes.
    tube_offsets are the places of upper arm and forearm along the axes of shoulder lift and elbow (m), housings the
    radii of the drawn body. calibration is the hash of the factory calibration in use ("" if its file names none), or
    None for the nominal numbers.
    """

    link_names: tuple[str, ...]
    acceleration_limit: Array
    effort_limit: Array
    base_mass: float
    base_radius: float
    base_length: float
    masses: Array
    centers_of_mass: Array
    inertias: Array
    tube_offsets: tuple[float, float]
    dh: DenavitHartenberg
    housings: Housings
    calibration: str | None = None


_Arm = TypeVar("_Arm", bound=Chain)


def known_arms() -> tuple[str, ...]:
    """Names that `load_arm` accepts."""
    return tuple(sorted(p.parent.name for p in _HERE.glob("*/default_kinematics.yaml")))


def load_arm(name: str = "ur10e", kinematics: Path | None = None) -> ArmModel:
    """Return the arm `name` with its nominal kinematics, or with a robot's factory calibration read from `kinematics`.

    `kinematics` is a file of the schema of Universal Robots' ROS 2 description (top-level key `kinematics`; m, rad; an
    optional `hash`). Its link frames are slid along their own joint axes to where the nominal ones lie, which changes
    no flange pose and keeps masses and shapes in place even where the calibrated frames of nearly parallel axes lie
    hundreds of metres away.

    Raises:
        InputError: unknown arm, or a kinematics file that is missing, malformed, non-finite, or of another arm.
    """
    if name not in known_arms():
        raise InputError(f"There is no arm {name!r}; choose one of: {', '.join(known_arms())}.")
    nominal = _nominal(name)
    if kinematics is None:
        return nominal
    advice = f"give the calibration of a {name}, in metres and radians"
    return with_link_transforms(nominal, *_read_kinematics(Path(kinematics)), Path(kinematics).name, advice)


@cache
def _nominal(name: str) -> ArmModel:
    """Return an arm that is known, read once: a run asks for it a hundred times."""
    folder = _HERE / name
    stack, _ = _read_kinematics(folder / "default_kinematics.yaml")
    (limits,) = _read(folder / "joint_limits.yaml", "joint_limits")
    sections = ("inertia_parameters", "dh_parameters", "offsets", "housing_radii")
    inertia, dh, offsets, radii = _read(folder / "physical_parameters.yaml", *sections)

    def limit(key: str) -> Array:
        return _frozen([_number(limits, joint, key) for joint in JOINT_NAMES])

    rotations = [_rotation(*(_number(inertia, "rotation", link, k) for k in POSE_KEYS[3:])) for link in LINKS]
    tensors = [_tensor({k: _number(inertia, "tensor", link, k) for k in _TENSOR_KEYS}) for link in LINKS]
    return ArmModel(
        name=name,
        joint_names=JOINT_NAMES,
        link_names=LINK_NAMES,
        stack=_frozen(stack),
        position_lower=limit("min_position"),
        position_upper=limit("max_position"),
        velocity_limit=limit("max_velocity"),
        acceleration_limit=limit("max_acceleration"),
        effort_limit=limit("max_effort"),
        base_mass=_number(inertia, "base_mass"),
        base_radius=_number(inertia, "links", "base", "radius"),
        base_length=_number(inertia, "links", "base", "length"),
        masses=_frozen([_number(inertia, f"{link}_mass") for link in LINKS]),
        centers_of_mass=_frozen(
            [[_number(inertia, "center_of_mass", f"{link}_cog", k) for k in "xyz"] for link in LINKS]
        ),
        inertias=_frozen([R @ tensor @ R.T for R, tensor in zip(rotations, tensors, strict=True)]),
        tube_offsets=(_number(offsets, "shoulder_offset"), _number(offsets, "elbow_offset")),
        dh=DenavitHartenberg(**{k: _number(dh, k) for k in ("d1", "a2", "a3", "d4", "d5", "d6")}),
        housings=Housings(**{f.name: _number(radii, f.name) for f in fields(Housings)}),
    )


def mounted(arm: _Arm, X_WB: RigidTransform) -> _Arm:
    """Return the same arm with its base at X_WB in a world whose z points up: on a ceiling, a wall or a pedestal."""
    # exactly +z for an upright base: rounding must not change a plan
    up = X_WB.rotation().matrix()[2]
    return replace(arm, up=_frozen(np.where(np.abs(up - np.round(up)) < 1e-12, np.round(up), up)))


def with_link_transforms(
    arm: ArmModel, stack: Array, calibration: str | None, source: str, advice: str = ""
) -> ArmModel:
    """Return the same arm with a robot's own link transforms: (6, 4, 4), X_{i-1,i}(0), rad and m.

    As in `load_arm`, the link frames are slid along their own joint axes to where those of `arm` lie, which changes no
    flange pose. `calibration` names the calibration (None: nominal), `source` says in an error whose kinematics these
    are, `advice` what to do.

    Raises:
        InputError: the transforms are another arm's.
    """
    stack = _slide_to_nominal(stack, arm.stack)
    postures = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, 6))
    shift = (joint_frames(stack, postures) - joint_frames(arm.stack, postures))[:, 5, :3, 3]
    if not (largest := float(np.linalg.norm(shift, axis=1).max())) <= MAX_CALIBRATION_SHIFT_M:
        advice = advice or f"connect a {arm.name}, or name this robot's arm in the scenario"
        raise InputError(f"{source} moves the flange by {largest * 1e3:.0f} mm from a nominal {arm.name}: {advice}.")
    return replace(arm, stack=_frozen(stack), calibration=calibration)


def forward_kinematics(arm: Chain, q: ArrayLike) -> RigidTransform:
    """Flange pose X_BF at joint angles q (n,) rad; at 500 Hz use `kinematics_and_jacobian`, which builds no object."""
    X = chain_poses(arm, q)
    return _rigid(X[:3, :3], X[:3, 3])


def chain_poses(arm: Chain, q: ArrayLike) -> Array:
    """Flange poses X_BF (..., 4, 4) at joint angles (..., n) rad."""
    return np.asarray(joint_frames(arm.stack, np.asarray(q, dtype=np.float64))[..., -1, :, :] @ arm.X_LF)


def link_frames(arm: Chain, q: ArrayLike) -> list[RigidTransform]:
    """Poses in B of base (identity) and links at q (n,) rad, in order; the last link's frame is the flange F."""
    chain = joint_frames(arm.stack, np.asarray(q, dtype=np.float64))
    chain[-1] = chain[-1] @ arm.X_LF
    return [_drake().RigidTransform(), *(_rigid(X[:3, :3], X[:3, 3]) for X in chain)]


def jacobian(arm: Chain, q: ArrayLike, p_FP: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Geometric Jacobian (6, n) of point P fixed in F: [omega_BF; v_BP] = J qdot, in axes of B."""
    return kinematics_and_jacobian(arm, np.asarray(q, dtype=np.float64), np.asarray(p_FP, dtype=np.float64))[2]


_ORIGIN = np.zeros(3)
_ORIGIN.setflags(write=False)


def kinematics_and_jacobian(arm: Chain, q: Array, p_FP: Array = _ORIGIN) -> tuple[Array, Array, Array]:
    """R_BF (..., 3, 3), p_BP (..., 3) m and the Jacobian J (..., 6, n) of P in B at q (..., n) rad, unchecked.

    J is geometric: column i is [z_i; z_i x (p_P - o_i)] with z_i, o_i the axis and origin of joint i
    (Siciliano et al., Robotics, 2009, Eq. 3.30, with rotation first as Drake orders spatial vectors).
    """
    X = joint_frames(arm.stack, q)
    X_BF = X[..., -1, :, :] @ arm.X_LF
    R = X_BF[..., :3, :3]
    p = R @ p_FP + X_BF[..., :3, 3]
    z, r = X[..., :3, 2], p[..., None, :] - X[..., :3, 3]
    J = np.empty((*q.shape[:-1], 6, q.shape[-1]))
    J[..., :3, :] = np.swapaxes(z, -1, -2)
    J[..., 3, :] = z[..., 1] * r[..., 2] - z[..., 2] * r[..., 1]
    J[..., 4, :] = z[..., 2] * r[..., 0] - z[..., 0] * r[..., 2]
    J[..., 5, :] = z[..., 0] * r[..., 1] - z[..., 1] * r[..., 0]
    return R, p, J


def sigma_min(J: ArrayLike, length: float = 1.0) -> float:
    """Smallest singular value of J (6, 6) with its linear rows divided by `length` (m): distance from singularity.

    A Jacobian mixes rad/s and m/s; `length` says how many metres of travel weigh as much as one radian of turning. The
    default, 1 m, is about the reach of a UR10e and leaves the SI numbers as they are.
    """
    scaled = np.array(J, dtype=np.float64)
    scaled[3:] /= length
    return float(np.linalg.svd(scaled, compute_uv=False)[-1])


def joint_frames(stack: Array, q: Array) -> Array:
    """Poses (..., n, 4, 4) in B of a chain's joints, turned by q (..., n) rad: ``stack`` is each in its parent."""
    c, s = np.cos(q)[..., None], np.sin(q)[..., None]
    x, y = stack[:, :, 0], stack[:, :, 1]
    step = np.empty((*q.shape, 4, 4))
    step[:] = stack
    step[..., 0] = x * c + y * s
    step[..., 1] = y * c - x * s
    for i in range(1, len(stack)):
        step[..., i, :, :] = step[..., i - 1, :, :] @ step[..., i, :, :]
    return step


def _slide_to_nominal(stack: Array, nominal: Array) -> Array:
    """Return the same chain with each frame but the last slid along its own joint axis, nearest to its nominal place.

    A slide along z_i commutes with the rotation about z_i, so X_{i-1,i} RotZ(q_i) may be split on either side of it.
    """
    zero = np.zeros(6)
    X, X_nominal = joint_frames(stack, zero), joint_frames(nominal, zero)
    slide = np.einsum("ij,ij->i", X[:, :3, 2], X_nominal[:, :3, 3] - X[:, :3, 3])
    slide[5] = 0.0
    out = stack.copy()
    out[:, :3, 3] += out[:, :3, 2] * slide[:, None]
    out[1:, 2, 3] -= slide[:-1]
    return out


def _read_kinematics(path: Path) -> tuple[Array, str]:
    """Link transforms (6, 4, 4) and the calibration hash of a kinematics file."""
    section: dict[str, Any] = dict(*_read(path, "kinematics"))
    fingerprint = str(section.pop("hash", ""))
    for found, wanted, where in [(section, LINKS, "kinematics")] + [
        (section.get(link), POSE_KEYS, f"kinematics.{link}") for link in LINKS
    ]:
        if not isinstance(found, Mapping) or set(found) != set(wanted):
            raise InputError(f"{path.name}: give exactly the keys {', '.join(wanted)} under {where}.")
    rows = ([_number(section, link, key, path=path) for key in POSE_KEYS] for link in LINKS)
    return np.array([pose_matrix(row) for row in rows]), fingerprint


def pose_matrix(row: Sequence[float]) -> Array:
    """Return the pose (4, 4) of x, y, z (m) and roll, pitch, yaw (rad)."""
    X = np.eye(4)
    X[:3, :3] = _rotation(*row[3:])
    X[:3, 3] = row[:3]
    return X


def _read(path: Path, *sections: str) -> list[Mapping[str, Any]]:
    """Return the mappings under top-level keys of a YAML file."""
    if not path.exists():
        raise InputError(f"{path} cannot be read (it does not exist); name an existing YAML file.")
    data = read_document(path)
    for section in sections:
        if not isinstance(data, Mapping) or not isinstance(data.get(section), Mapping):
            raise InputError(
                f"{path.name} has no section {section!r}; write it as Universal Robots' ROS 2 description does."
            )
    return [dict(data[section]) for section in sections]


def _number(section: Mapping[str, Any], *keys: str, path: Path | None = None) -> float:
    """Return a finite number at section[keys[0]][keys[1]]...; YAML 1.1 leaves 1e-05 as text, which is accepted."""
    value: Any = section
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    number = as_number(value)
    if not abs(number) <= LARGEST_NUMBER:
        where = f"{path.name}: " if path else ""
        raise InputError(f"{where}{'.'.join(keys)} must be a finite number, it is {value!r}.")
    return number


_TENSOR_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def _tensor(t: Mapping[str, float]) -> Array:
    return np.array([[t["ixx"], t["ixy"], t["ixz"]], [t["ixy"], t["iyy"], t["iyz"]], [t["ixz"], t["iyz"], t["izz"]]])


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    return np.asarray(_drake().RollPitchYaw(roll, pitch, yaw).ToRotationMatrix().matrix(), dtype=np.float64)


@cache
def _drake() -> Any:
    """pydrake.math, imported at the first call.

    The process that supervises a robot has an ArmModel and no use for it.
    """
    return importlib.import_module("pydrake.math")


def _rigid(R: Any, p: Any) -> RigidTransform:
    drake = _drake()
    X: RigidTransform = drake.RigidTransform(drake.RotationMatrix(R), p)
    return X


def _frozen(values: ArrayLike) -> Array:
    out = np.array(values, dtype=np.float64)
    out.setflags(write=False)
    return out
