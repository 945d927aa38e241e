"""Builds the cell's surroundings from a scenario: boxes and mesh files, placed in the robot's base."""

from pathlib import Path

import numpy as np

from weldcal.calibration.planning.clearance import Obstacle, Surroundings
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.workpieces.mesh_files import read_surface
from weldcal.models.workpieces.reading import MESH_SUFFIXES, read_shape
from weldcal.models.workpieces.shape import UNITS_M
from weldcal.systems.scenario.schema import ObstacleConfig, Scenario


def surroundings_of(scenario: Scenario) -> Surroundings:
    """What the arm of a scenario must not touch.

    Raises:
        InputError: an obstacle is neither a box nor a mesh, or its file cannot be read.
    """
    return Surroundings(tuple(_obstacle(k, config) for k, config in enumerate(scenario.surroundings)))


def _obstacle(k: int, config: ObstacleConfig) -> Obstacle:
    name = config.name or f"surroundings {k + 1}"
    if (config.box_m is None) == (config.mesh is None):
        raise InputError(f"surroundings[{k}] needs either box_m: [x, y, z] or mesh: FILE.")
    mesh = _box(k, config.box_m) if config.mesh is None else _mesh(Path(config.mesh), config.unit)
    return Obstacle(name, mesh.transformed(config.pose.pose()), config.margin_m)


def _mesh(path: Path, unit: str) -> TriMesh:
    """The surface of a file; a mesh may be open."""
    if path.suffix.lower() in MESH_SUFFIXES and unit in UNITS_M:
        return read_surface(path, UNITS_M[unit])
    return read_shape(path, unit).mesh


def _box(k: int, size_m: list[float] | None) -> TriMesh:
    size = np.array(size_m, dtype=float)
    if size.shape != (3,) or not (size > 0.0).all():
        raise InputError(f"surroundings[{k}].box_m needs three positive lengths, not {size_m}.")
    x, y, z = 0.5 * size
    return extrude(np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), -float(z), float(z))
