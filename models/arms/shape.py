"""The shape of an arm, link by link: the drawn solids of a known arm, or the meshes of a URDF, and their capsules."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from weldcal.models.arms.chain import PICTURES, chain_capsules, urdf_links
from weldcal.models.arms.kinematics import ArmModel, Chain, link_frames
from weldcal.models.arms.urdf import Capsule, link_capsules, link_solids, placed_solid
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh

_MESHES = (".stl", ".obj", ".ply", ".gltf", ".glb")  # what Open3D reads; it reads no .dae
TUBE_M = 0.06  # a choice: the radius of the links of most arms that carry 3 to 12 kg is less
_LARGEST_M = 5.0  # of a link: a choice, above any arm; more is millimetres


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A body's name, the pose X_BL of its frame in the base, and its meshes in that frame, m; they may overlap.

    ``link`` is how many joints carry it.
    """

    name: str
    X_BL: RigidTransform
    meshes: Sequence[TriMesh]
    link: int = 0

    def distances(self, points_B: Array, reach_m: float) -> Array:
        """Distances (N,) m of points (N, 3) m of B from the surface, negative inside closed meshes.

        Infinite for points farther than ``reach_m`` from the boxes around the meshes.
        """
        found, p = np.full(len(points_B), np.inf), self.X_BL.inverse().multiply(points_B.T).T
        for mesh in self.meshes:
            low, high = mesh.bounds
            near = np.flatnonzero(((p > low - reach_m) & (p < high + reach_m)).all(axis=1))
            if len(near):
                found[near] = np.minimum(found[near], mesh.distances(p[near]))
        return found


def arm_shape(arm: ArmModel, q: ArrayLike) -> list[BodyShape]:
    """Return the links of a known arm at q (6,) rad, as they are drawn (see link_solids); their flange disc is none."""
    return [BodyShape(arm.link_names[k], X, link_solids(arm, k), k) for k, X in enumerate(link_frames(arm, q))]


def urdf_shape(path: Path, q: ArrayLike) -> list[BodyShape]:
    """Return the links of a URDF file at the angles q (n,) rad of its chain, by their visual, else collision elements.

    Raises:
        InputError: see urdf_links, or a link's meshes cannot be read.
    """
    found = []
    for link, X_BL, carried in urdf_links(path, q):
        of_kind = [link.findall(kind) for kind in PICTURES if link.find(kind) is not None]
        read = ([_mesh(path, e) for e in elements] for elements in of_kind)
        meshes = next((each for each in read if None not in each), None)
        if meshes is not None:
            found.append(BodyShape(link.get("name", ""), X_BL, [mesh for mesh in meshes if mesh is not None], carried))
        elif of_kind:
            why = f"no mesh of '{link.get('name')}' that can be read: put STL, OBJ or PLY files beside it"
            raise InputError(f"'{path.name}' has {why}, by the names in it.")
    return found


def arm_capsules(arm: Chain) -> list[Capsule]:
    """Capsules that enclose the links of an arm, in the frames of `link_frames`.

    Those of a URDF enclose the shapes of its links; where it has none, they are tubes from joint to joint.

    Raises:
        InputError: the meshes of a URDF's link cannot be read.
    """
    if isinstance(arm, ArmModel):
        return link_capsules(arm)
    zero = np.zeros(arm.n)
    X = link_frames(arm, zero)
    if arm.file is None:
        to_frame = [*[RigidTransform()] * arm.n, RigidTransform(arm.X_LF).inverse()]
        rows = [(to_frame[int(k)], int(k), v) for k, *v in chain_capsules(arm.name)]
        return [Capsule(k, Y @ np.array(v[:3]), Y @ np.array(v[3:6]), v[6]) for Y, k, v in rows]
    bodies = [(b, X[b.link].inverse() @ b.X_BL) for b in urdf_shape(arm.file, zero)]
    found = [_enclosing(b.link, (X_LB @ m.vertices.T).T) for b, X_LB in bodies for m in b.meshes]
    tubes = (Capsule(k, zero[:3], X[k].inverse() @ X[k + 1].translation(), TUBE_M) for k in range(arm.n))
    return found or list(tubes)


def _enclosing(link: int, points: Array) -> Capsule:
    """Return a capsule of least radius about the longest axis through the middle of points (N, 3) that holds all."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    axis = np.linalg.eigh(np.cov((points - middle).T))[1][:, 2]
    along = (points - middle) @ axis
    across = np.linalg.norm(points - middle - along[:, None] * axis, axis=1)
    radius = float(across.max())
    cap = np.sqrt(radius**2 - across**2)
    low, high = float((along + cap).min()), float((along - cap).max())
    if low > high:
        low = high = 0.5 * (low + high)
    return Capsule(link, middle + low * axis, middle + high * axis, radius)


def _mesh(urdf: Path, picture: ET.Element) -> TriMesh | None:
    """Return the mesh of a visual or collision element in its link's frame; None where its file cannot be read."""
    if (named := picture.find("geometry/mesh")) is None:
        return placed_solid(picture)
    name = named.get("filename", "").removeprefix("file://").removeprefix("package://")
    places = (folder / part for folder in urdf.resolve().parents for part in (name, name.partition("/")[2]))
    file = next((one for one in places if one.is_file() and one.suffix.lower() in _MESHES), None)
    if file is None:
        return None
    from weldcal.models.workpieces.mesh_files import read_surface  # only here: a known arm needs no files

    mesh, scale = read_surface(file, 1.0), np.array(named.get("scale", "1 1 1").split(), dtype=float)
    if (size := float(np.ptp(mesh.vertices * scale, axis=0).max())) > _LARGEST_M:
        raise InputError(f"'{file.name}' is {size:.0f} m wide: give it scale=\"0.001 0.001 0.001\" in '{urdf.name}'.")
    return placed_solid(picture, TriMesh(mesh.vertices * scale, mesh.triangles))
