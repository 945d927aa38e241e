"""The shape of an arm at its joint angles, link by link: the drawn solids of a known arm, or the meshes of a URDF."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from weldcal.models.arms.chain import PICTURES, read_robot, urdf_link_poses
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arms.urdf import link_solids, placed_solid
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh

_MESHES = (".stl", ".obj", ".ply", ".gltf", ".glb")  # what Open3D reads; it reads no .dae


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A body's name, the pose X_BL of its frame in the base, and its meshes in that frame, m; they may overlap."""

    name: str
    X_BL: RigidTransform
    meshes: tuple[TriMesh, ...]

    @property
    def closed(self) -> bool:
        """Whether all meshes are closed, so that inside and outside differ."""
        return all(mesh.watertight() for mesh in self.meshes)

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
    poses = zip(arm.link_names, link_frames(arm, q), strict=True)
    return [BodyShape(name, X, tuple(link_solids(arm, k))) for k, (name, X) in enumerate(poses)]


def urdf_shape(path: Path, q: ArrayLike) -> list[BodyShape]:
    """Return the links of a URDF file at the angles q (n,) rad of its chain, by their visual, else collision elements.

    Raises:
        InputError: see urdf_link_poses, or a link's meshes cannot be read.
    """
    poses, found = urdf_link_poses(path, q), []
    for link in read_robot(path).iter("link"):
        name, meshes = link.get("name", ""), list[TriMesh | None]()
        for kind in PICTURES:
            meshes = [_mesh(path, picture) for picture in link.findall(kind)]
            if meshes and None not in meshes:
                break
        if None in meshes:
            raise InputError(
                f"'{path.name}' has no mesh of '{name}' that can be read: put the files that it names beside it, as"
                f" {', '.join(form[1:].upper() for form in _MESHES[:3])}."
            )
        if meshes:
            found.append(BodyShape(name, poses[name], tuple(mesh for mesh in meshes if mesh is not None)))
    if not found:
        raise InputError(f"'{path.name}' has no shapes: give a URDF whose links have visual or collision meshes.")
    return found


def _mesh(urdf: Path, picture: ET.Element) -> TriMesh | None:
    """Return the mesh of a visual or collision element in its link's frame; None where its file cannot be read."""
    geometry = picture.find("geometry/mesh")
    if geometry is None:
        return placed_solid(picture)
    # only here: a known arm needs no files
    from weldcal.models.workpieces.mesh_files import read_surface

    named = geometry.get("filename", "").removeprefix("file://")
    package, _, inside = named.removeprefix("package://").partition("/")
    places = [urdf.parent / named]
    if named.startswith("package://"):
        places = [folder / rest for folder in urdf.resolve().parents for rest in (f"{package}/{inside}", inside)]
    file = next((one for one in places if one.is_file() and one.suffix.lower() in _MESHES), None)
    if file is None:
        return None
    mesh, scale = read_surface(file, 1.0), np.array(geometry.get("scale", "1 1 1").split(), dtype=float)
    return placed_solid(picture, TriMesh(mesh.vertices * scale, mesh.triangles))
