"""Pose tables as the pendants and controllers of many makers write them, and what the importer makes of them.

    python -m tests.calibration.hand_eye.makers --sets 10

prints the count: right, asked (one sentence that asks for the form) or WRONG. Rotations are built of elementary turns
here; SciPy takes the angles. Sources of the conventions: manuals of the makers, Basler rc_cube "pose formats", Mech-Mind
"Euler Angles", vathos "Rotations".
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

N = 14


@dataclass(frozen=True)
class Maker:
    """How one maker writes poses: names of the columns, axes of its angles for SciPy, and the order of the columns."""

    name: str
    header: str
    axes: str
    columns: tuple[int, int, int] = (0, 1, 2)
    mm: bool = True
    degrees: bool = True


FIXED, MOVING = "xyz", "ZYX"
BY_AXIS = (2, 1, 0)  # turns in the order z, y, x under columns about x, y, z
MAKERS = (
    Maker("Fanuc", "X,Y,Z,W,P,R", FIXED),
    Maker("Yaskawa", "X,Y,Z,Rx,Ry,Rz", FIXED),
    Maker("Denso", "X,Y,Z,RX,RY,RZ,FIG", FIXED),
    Maker("Mitsubishi", "X,Y,Z,A,B,C", FIXED),
    Maker("Dobot", "X;Y;Z;Rx;Ry;Rz", FIXED),
    Maker("Aubo", "x,y,z,roll,pitch,yaw", FIXED, mm=False, degrees=False),
    Maker("Han's", "X,Y,Z,RX,RY,RZ", FIXED),
    Maker("JAKA", "x,y,z,rx,ry,rz", FIXED),
    Maker("JAKA in radians", "x,y,z,rx,ry,rz", FIXED, degrees=False),
    Maker("Fairino", "x,y,z,rx,ry,rz", FIXED),
    Maker("Rokae", "X,Y,Z,A,B,C", FIXED),
    Maker("Siasun", "X,Y,Z,A,B,C", FIXED),
    Maker("Techman", "X,Y,Z,RX,RY,RZ", FIXED),
    Maker("Elite", "x,y,z,rx,ry,rz", FIXED, degrees=False),
    Maker("STEP", "X,Y,Z,A,B,C", FIXED),
    Maker("Hyundai", "X,Y,Z,RX,RY,RZ", MOVING, BY_AXIS),
    Maker("Flexiv", "x,y,z,rx,ry,rz", FIXED, mm=False),
    Maker("Delta", "X,Y,Z,RX,RY,RZ", FIXED),
    Maker("xArm", "x,y,z,roll,pitch,yaw", FIXED),
    Maker("Kinova", "x,y,z,theta_x,theta_y,theta_z", FIXED, mm=False),
    Maker("KUKA", "X,Y,Z,A,B,C", MOVING),
    Maker("Estun", "X,Y,Z,A,B,C", MOVING),
    Maker("Inovance", "X,Y,Z,A,B,C", MOVING),
    Maker("Efort", "X,Y,Z,A,B,C", MOVING),
    Maker("Nachi", "X,Y,Z,R,P,Y", MOVING),
    Maker("Epson", "X,Y,Z,U,V,W", MOVING),
    Maker("Panasonic", "X,Y,Z,U,V,W", MOVING),
    Maker("ABB Euler", "X,Y,Z,EZ,EY,EX", MOVING),
    Maker("Kawasaki", "X,Y,Z,O,A,T", "ZYZ"),
    Maker("QJAR", "X,Y,Z,A,B,C", "ZYZ"),
    Maker("Comau", "X,Y,Z,A,E,R", "ZYZ"),
    Maker("Doosan", "x,y,z,a,b,c", "ZYZ"),
    Maker("Omron Adept", "x,y,z,yaw,pitch,roll", "ZYZ"),
    Maker("Turin", "X,Y,Z,A,B,C", "XYZ"),
    Maker("Staubli", "X,Y,Z,Rx,Ry,Rz", "XYZ"),
    Maker("Mecademic", "x,y,z,alpha,beta,gamma", "XYZ"),
    Maker("Universal Robots", "x,y,z,rx,ry,rz", "vector", mm=False, degrees=False),
    Maker("xArm axis angle", "x,y,z,rx,ry,rz", "vector"),
    Maker("ABB", "x,y,z,q1,q2,q3,q4", "wxyz"),
    Maker("Franka", "x,y,z,qx,qy,qz,qw", "xyzw", mm=False),
    Maker("viam", "x,y,z,o_x,o_y,o_z,theta", "orientation"),
)


def turn(axis: str, angle: float) -> Array:
    """Rotation about an axis, by hand."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis.lower()]
    R[i, i], R[j, j], R[i, j], R[j, i] = c, c, -s, s
    return R


def rotation_of(axes: str, angles: Array) -> Array:
    """Fixed axes (lower case) multiply from the left, moving ones from the right."""
    R = np.eye(3)
    for axis, angle in zip(axes, angles, strict=True):
        R = turn(axis, angle) @ R if axes.islower() else R @ turn(axis, angle)
    return R


def numbers_of(maker: Maker, R: Array) -> Array:
    """Return the numbers of a rotation as the maker writes them; checked by `rotation_of`."""
    one = Rotation.from_matrix(R)
    if maker.axes in ("wxyz", "xyzw"):
        return one.as_quat(scalar_first=maker.axes == "wxyz")
    if maker.axes == "vector":
        return one.as_rotvec(degrees=maker.degrees)
    if maker.axes == "orientation":
        lon, lat, theta = one.as_euler("ZYZ")
        assert np.allclose(rotation_of("ZYZ", np.array([lon, lat, theta])), R)
        return np.array([*R[:, 2], np.degrees(theta)])
    angles = one.as_euler(maker.axes)
    assert np.allclose(rotation_of(maker.axes, angles), R)
    return (np.degrees(angles) if maker.degrees else angles)[list(maker.columns)]


def judged(maker: Maker, rng: np.random.Generator, folder: Path) -> tuple[str, str]:
    """Write a set of a maker, read it, and compare the robot's poses with the truth."""
    R = np.array([turn("z", a) @ turn("x", np.pi + b) @ turn("y", c) for a, b, c in rng.uniform(-0.7, 0.7, (N, 3))])
    p = np.array([0.6, 0.0, 0.4]) + rng.uniform(-0.3, 0.3, (N, 3))
    mark = ";" if ";" in maker.header else ","
    more = maker.header.count(mark) - 2 - len(numbers_of(maker, R[0]))
    lines = [maker.header]
    for one, at in zip(R, p, strict=True):
        cells = [*(at * (1e3 if maker.mm else 1.0)), *numbers_of(maker, one), *([5.0] * more)]
        lines.append(mark.join(f"{v:.5f}" for v in cells))
    (folder / "robot.csv").write_text("\n".join(lines) + "\n")
    X, Y = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3] = turn("z", 1.2) @ turn("x", 0.4), [0.05, -0.02, 0.08]
    Y[:3, :3], Y[:3, 3] = turn("y", 0.3), [0.7, 0.1, 0.0]
    seen = np.zeros((N, 4, 4))
    for k in range(N):
        F = np.eye(4)
        F[:3, :3], F[:3, 3] = R[k], p[k]
        noise = np.eye(4)
        noise[:3, :3] = rotation_of("xyz", 1e-3 * rng.normal(size=3))
        noise[:3, 3] = 2e-4 * rng.normal(size=3)
        seen[k] = np.linalg.inv(X) @ np.linalg.inv(F) @ Y @ noise
    np.save(folder / "camera.npy", seen)
    try:
        found = read_pairs(folder, mounting="eye_in_hand")
    except InputError as why:
        return "asked", str(why)
    off = max(float(np.abs(found.robot[:, :3, :3] - R).max()), float(np.abs(found.robot[:, :3, 3] - p).max()))
    words = str(found.reading["robot"]["reading"])
    return ("right" if off < 1e-4 else "WRONG"), words


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=10)
    given = parser.parse_args()
    total: Counter[str] = Counter()
    for number, maker in enumerate(MAKERS):
        counts: Counter[str] = Counter()
        with tempfile.TemporaryDirectory() as folder:
            for k in range(given.sets):
                verdict, words = judged(maker, np.random.default_rng([number, k]), Path(folder))
                counts[verdict] += 1
        total += counts
        print(f"{maker.name:20s}{maker.header:32s}{dict(counts)} {words}", flush=True)
    print(f"{len(MAKERS)} forms of makers, {sum(total.values())} sets: {dict(total)}")


if __name__ == "__main__":
    main()
