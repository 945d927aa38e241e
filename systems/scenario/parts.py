"""Make a scenario's arm, surroundings and workpiece from its keys and files."""

import dataclasses as dc
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.planning.clearance import Obstacle, Surroundings
from weldcal.models.arms.kinematics import ArmModel, load_arm, mounted, with_link_transforms
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh, extrude
from weldcal.models.workpieces.drawing import resampled
from weldcal.models.workpieces.part import Part, bowed
from weldcal.models.workpieces.reading import MESH_SUFFIXES, read_shape
from weldcal.models.workpieces.seam_input import SeamSource, chained, seam_of
from weldcal.models.workpieces.seams import JOINTS, DrawnSeam
from weldcal.models.workpieces.shape import UNITS_M, PartEdge, PartShape
from weldcal.systems.scenario.schema import ObstacleConfig, Scenario, SeamConfig, WorkpieceConfig

OF_PLATES = ("bend_radius_mm", "hole_from_mm")
CORNER_RAD = math.radians(15.0)  # by which the bisector turns at one of a seam's points
ROUNDED_M = 0.002  # to each side of a corner the drawing is rounded
# Between two outside corners: on a leg of 8 mm, the end of a sheet, the tip felt six points and then the corner.
LEAST_LEG_M = 0.02


def nominal_arm(scenario: Scenario) -> ArmModel:
    """The arm of a scenario, with the scenario's kinematics file where it names one.

    Raises:
        InputError: the arm is not known, or its file is not one.
    """
    arm = load_arm(scenario.arm, None if scenario.kinematics is None else Path(scenario.kinematics))
    return mounted(arm, scenario.base.pose())


def corrected_arm(scenario: Scenario, arm: ArmModel) -> ArmModel:
    """The arm as the scenario's corrected kinematics state it, else `arm`, by which its controller computes.

    Raises:
        InputError: the file cannot be read, or is of another robot.
    """
    if scenario.corrected_kinematics is None:
        return arm
    path = Path(scenario.corrected_kinematics)
    read = load_arm(scenario.arm, path)
    return with_link_transforms(arm, read.stack, read.calibration, f"corrected_kinematics: '{path.name}'")


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
        from weldcal.models.workpieces.mesh_files import read_surface

        return read_surface(path, UNITS_M[unit])
    return read_shape(path, unit).mesh


def _box(k: int, size_m: list[float] | None) -> TriMesh:
    size = np.array(size_m, dtype=float)
    if size.shape != (3,) or not (size > 0.0).all():
        raise InputError(f"surroundings[{k}].box_m needs three positive lengths, not {size_m}.")
    x, y, z = 0.5 * size
    return extrude(np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), -float(z), float(z))


def check_workpiece(spec: WorkpieceConfig) -> None:
    """Check what a scenario says of a part from a file, without reading the part.

    Raises:
        InputError: one sentence that says what to change.
    """
    if spec.file is None:
        named = [name for name in ("units", "joint") if getattr(spec, name) is not None] + ["seams"] * bool(spec.seams)
        if named:
            raise InputError(f"workpiece.{named[0]} belongs to a part from a file: write workpiece.file too.")
        return
    if not Path(spec.file).is_file():
        raise InputError(
            f"workpiece.file: there is no file '{spec.file}'; its path is relative to the scenario's file."
        )
    if spec.units is not None and spec.units not in UNITS_M:
        raise InputError(f"workpiece.units must be {', '.join(UNITS_M)}, not '{spec.units}'.")
    if spec.joint not in JOINTS:
        said = "is missing" if spec.joint is None else f"cannot be '{spec.joint}'"
        raise InputError(f"workpiece.joint {said}: write {', '.join(JOINTS[:-1])} or {JOINTS[-1]}.")
    if not spec.seams:
        raise InputError(
            "workpiece.seams is missing: write seams: [{edges: [1]}] with a number from weldcal part"
            f" {Path(spec.file).name}, or seams: [{{polyline: seam.csv}}]."
        )
    for seam in spec.seams:
        source(seam)
        if seam.polyline is not None and not Path(seam.polyline).is_file():
            raise InputError(f"workpiece.seams: there is no file '{seam.polyline}'.")
    for name in OF_PLATES:
        if getattr(spec, name) is not None:
            raise InputError(f"workpiece.{name} is for the plates of the package, not for a part from a file.")


def source(seam: SeamConfig) -> SeamSource:
    """A seam of the scenario; raises InputError."""
    polyline = None if seam.polyline is None else Path(seam.polyline)
    return SeamSource(polyline, tuple(seam.edges), seam.direction, 1e-3 * seam.start_mm, 1e-3 * seam.end_mm)


def part_of(spec: WorkpieceConfig) -> Part:
    """The part as drawn, with its seams: the first one, and the others in the order of welding.

    Raises:
        InputError: its file or its seam cannot be used.
    """
    check_workpiece(spec)
    assert spec.file is not None
    assert spec.joint is not None
    shape = read_shape(Path(spec.file), spec.units)
    found = []
    for k, seam in enumerate(spec.seams):
        parts = legs(shape, source(seam), spec.joint)
        if len(parts) > 1 and seam.feel is not False and spec.joint != "butt":
            _check_legs(shape, seam.edges, parts)
        found += [dc.replace(leg, feel=seam.feel, listed=k) for leg in parts]
    return Part(shape, found[0], tuple(found[1:]))


def _check_legs(shape: PartShape, edges: list[int], parts: list[DrawnSeam]) -> None:
    short = [leg for leg in parts if leg.length_m < LEAST_LEG_M]
    if short:
        kept = [id for id in edges if shape.edge(id).length_m >= LEAST_LEG_M]
        without = ", ".join(f"{{edges: [{id}]}}" for id in kept)
        raise InputError(
            f"workpiece.seams: between two corners of edges {', '.join(map(str, edges))} the seam is only"
            f" {1e3 * short[0].length_m:.0f} mm long; the tip needs {1e3 * LEAST_LEG_M:.0f} mm to feel it. "
            + (f"Leave it out, as in seams: [{without}], or write" if kept else "Write")
            + " feel: false beside the edges."
        )


def legs(shape: PartShape, source: SeamSource, joint: str) -> list[DrawnSeam]:
    """A seam as drawn, or its legs between sharp outside corners, as those of a square tube.

    Across one, tip and torch cannot both follow.

    Raises:
        InputError: as seam_of.
    """
    ids = list(source.edges)
    turns = [joint == "butt" and _turn(shape.edge(a), shape.edge(b)) for a, b in pairwise(ids)]
    if any(turns):  # around the corner of a tube the faces of a butt are level in each leg only
        line = resampled(chained(shape, ids)[0], None, closed=False)[0]
        line = line if source.direction == "forward" else line[::-1]
        t = np.gradient(line, axis=0)
    else:
        whole = seam_of(shape, source, joint)
        line, t, corners = whole.points_P, whole.tangents_P, _outside_corners(whole)
        turns = [_near(shape.edge(a), shape.edge(b), corners) for a, b in pairwise(ids)]
        if not any(turns):
            return [whole]
    groups = [ids[:1]]
    for id, turn in zip(ids[1:], turns, strict=True):
        groups = [*groups, [id]] if turn else [*groups[:-1], [*groups[-1], id]]
    found = []
    for group in groups if source.direction == "forward" else groups[::-1]:
        leg = seam_of(shape, SeamSource(edges=tuple(group)), joint)
        near = int(np.argmin(np.linalg.norm(line - leg.points_P[len(leg.points_P) // 2], axis=1)))
        found.append(leg if leg.tangents_P[len(leg.points_P) // 2] @ t[near] > 0.0 else leg.reversed())
    found[0] = found[0].between(source.start_m, found[0].length_m)
    return [*found[:-1], found[-1].between(0.0, found[-1].length_m - source.end_m)]


def _turn(a: PartEdge, b: PartEdge) -> bool:
    """Return whether the joints at two straight edges open in different directions."""
    if a.up_P is None or b.up_P is None or not len(a.points_P) == len(b.points_P) == 2:
        return False
    return float(a.up_P @ b.up_P) < math.cos(CORNER_RAD)


def _near(a: PartEdge, b: PartEdge, corners: NDArray[np.float64]) -> bool:
    """Return whether one of the corners (N,3) lies where an edge meets another."""
    ends = b.points_P[[0, -1]]
    meet = ends[int(np.argmin(np.linalg.norm(ends[:, None] - a.points_P[[0, -1]], axis=2).min(axis=1)))]
    return len(corners) > 0 and bool(np.linalg.norm(corners - meet, axis=1).min() < ROUNDED_M)


def _outside_corners(seam: DrawnSeam) -> NDArray[np.float64]:
    """Points (N,3) where a seam turns away from the side to which its joint is open."""
    up, t = seam.up_P, seam.tangents_P
    angle = np.arccos(np.clip(np.sum(up[1:] * up[:-1], axis=1), -1.0, 1.0))
    after, before = (np.clip(np.arange(len(angle)) + k, 0, len(t) - 1) for k in (3, -2))
    outside = np.sum((t[after] - t[before]) * (up[1:] + up[:-1]), axis=1) < 0.0
    return np.asarray(seam.points_P[np.flatnonzero((angle > CORNER_RAD) & outside)])


def made(part: Part, spec: WorkpieceConfig, rng: np.random.Generator) -> Part:
    """The part as made: bowed by groove_error.translation_mm in a direction drawn from the run's seed."""
    amplitude = 1e-3 * spec.groove_error.translation_mm
    if amplitude == 0.0:
        return part
    turn = rng.uniform(-math.pi, math.pi)
    direction: NDArray[np.float64] = np.array([math.cos(turn), math.sin(turn), 0.0])
    return bowed(part, amplitude, direction)
