"""Arms of other makers by their Denavit-Hartenberg tables, with a forward kinematics that is no code under test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QUARTER = np.pi / 2
# Rows of d (m), a (m), alpha (rad) after the makers' data sheets and URDFs.
TABLES = {
    # spherical wrist, elbow off the forearm's axis
    "abb_irb120": [(0.29, 0, -QUARTER), (0, 0.27, 0), (0, 0.07, -QUARTER), (0.302, 0, QUARTER), (0, 0, -QUARTER), (0.072, 0, 0)],
    # spherical wrist, shoulder off the first axis
    "kuka_kr16": [(0.675, 0.26, -QUARTER), (0, 0.68, 0), (0, 0.035, -QUARTER), (0.67, 0, QUARTER), (0, 0, -QUARTER), (0.158, 0, 0)],
    # three parallel axes
    "techman_tm5": [(0.1452, 0, -QUARTER), (0, 0.429, 0), (0, 0.4115, 0), (-0.1223, 0, QUARTER), (0.106, 0, QUARTER), (0.1144, 0, 0)],
    # neither: an offset between axes 4 and 6
    "fanuc_crx10": [(0.245, 0, -QUARTER), (0, 0.71, np.pi), (0, 0, -QUARTER), (-0.54, 0, QUARTER), (0.15, 0, -QUARTER), (-0.16, 0, np.pi)],
    # neither: axes 5 and 6 do not meet
    "xarm6": [(0.267, 0, -QUARTER), (0, 0.28949, 0), (0, 0.0775, -QUARTER), (0.3425, 0, QUARTER), (0, 0.076, -QUARTER), (0.097, 0, 0)],
}  # fmt: skip


def pose_by_table(name: str, q: Array) -> Array:
    """Poses (..., 4, 4) of the flange by the Denavit-Hartenberg formula, written out."""
    X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for k, (d, a, alpha) in enumerate(TABLES[name]):
        c, s, ca, sa, o = np.cos(q[..., k]), np.sin(q[..., k]), np.cos(alpha), np.sin(alpha), 0.0 * q[..., k]
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [o, o + sa, o + ca, o + d], [o, o, o, o + 1]]
        X = X @ np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return X


def urdf_by_table(name: str, limit: float = 3.1) -> str:
    """A URDF without shapes: RotZ, and then the link's offset and twist as the origin of the next joint."""
    tree = ['<robot name="other"><link name="base_link"/>']
    origin, above = 'xyz="0 0 0" rpy="0 0 0"', "base_link"
    for k, (d, a, alpha) in enumerate(TABLES[name], 1):
        tree.append(
            f'<link name="link_{k}"/><joint name="joint_{k}" type="revolute"><parent link="{above}"/>'
            f'<child link="link_{k}"/><origin {origin}/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="3" effort="100"/></joint>'
        )
        origin, above = f'xyz="{a} 0 {d}" rpy="{alpha} 0 0"', f"link_{k}"
    tree.append('<link name="tool0"/><joint name="face" type="fixed"><parent link="link_6"/><child link="tool0"/>')
    return "\n".join([*tree, f"<origin {origin}/></joint></robot>"])
