"""Puts a user's part, and a copy of the tool to change, into a new cell."""

import dataclasses as dc
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.part import Part, WeldPart, numbered, seam_count
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.seam_planner import plan_drawn_seam
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.scenario.schema import ErrorConfig, PoseConfig, Scenario, SeamConfig, ToolFile, WorkpieceConfig
from weldcal.systems.station import Station, make_station

TOOL = "tool.yaml"
NARROW_RAD = np.deg2rad(75.0)  # a V is narrower than this, a fillet wider
OPEN_ABOVE = 0.3  # z of the joint's bisector
TURNS_DEG = (90.0, -90.0, 0.0, 180.0)
OFF_MM, OFF_DEG = 6.0, 1.5  # of the simulated part from its guess: the scan has to find it
PLACE_M = (0.65, 0.0)  # of the part's middle, where the demo's plate lies


def add_part(scenario: Scenario, folder: Path, part: Path, edges: list[int], joint: str | None) -> None:
    """Copy a part's file into the cell's folder, and make it the scenario's workpiece, standing on the table.

    Without `edges` the longest concave one that opens upwards is the seam; without `joint` its angle says which joint it is.

    Raises:
        InputError: the part cannot be read, has no such edge, or no concave one.
    """
    shape = read_shape(part)
    chosen = _chosen(shape, part, edges)
    name = joint or _joint(chosen[0])
    scenario.workpiece = WorkpieceConfig(
        file=part.name,
        seams=[SeamConfig(edges=[edge.id for edge in chosen])],
        joint=name,
        pose_guess=_standing(shape.mesh, TURNS_DEG[0], 0.5 * shape.mesh.bounds.sum(axis=0), scenario),
        located_by="scan",
        placement_error=ErrorConfig(OFF_MM, OFF_DEG),
    )
    shutil.copyfile(part, folder / part.name)


def weldable_place(scenario: Scenario) -> PoseConfig | None:
    """The first of some poses on the table in which the arm can weld the seams of a scenario's part; None where there is none."""
    try:
        station = make_station(scenario, 0)
    except WeldcalError:
        return None  # a run says why
    try:
        part = station.cad
        if not isinstance(part, Part) or station.tool is None:
            return None
        seams = [numbered(part, k) for k in range(seam_count(part))]
        line = np.concatenate([seam.seam_P for seam in seams])
        for middle in (0.5 * part.mesh.bounds.sum(axis=0), 0.5 * (line.min(axis=0) + line.max(axis=0))):
            for turn in TURNS_DEG:
                guess = _standing(part.mesh, turn, middle, scenario)
                if all(_weldable(scenario, station, k, seam, guess) for k, seam in enumerate(seams)):
                    return guess
    finally:
        station.close()
    return None


def _weldable(scenario: Scenario, station: Station, number: int, part: WeldPart, guess: PoseConfig) -> bool:
    config = servo_config(scenario, station, number)
    planning = dc.replace(seam_planning(scenario, station, config), workpiece=part, X_BP_guess=guess.pose())
    return plan_drawn_seam(planning, 0).seam is not None


def _standing(mesh: TriMesh, turn_deg: float, middle_P: NDArray[np.float64], scenario: Scenario) -> PoseConfig:
    """The pose of a part that stands on the table as it is drawn, turned about z, with a point of it at PLACE_M."""
    R = RotationMatrix.MakeZRotation(np.deg2rad(turn_deg)).matrix()
    x, y = np.array(PLACE_M) - (R @ middle_P)[:2]
    z = scenario.calibration.table_z_m - float(mesh.bounds[0, 2])
    return PoseConfig([round(float(v), 4) for v in (x, y, z)], [0.0, 0.0, turn_deg])


def add_tool(scenario: Scenario, folder: Path, tool: Path) -> None:
    """Copy a tool's file into the cell's folder as tool.yaml, and make it the scenario's tool."""
    shutil.copyfile(tool, folder / TOOL)
    scenario.tool = ToolFile(TOOL)


def _chosen(shape: PartShape, part: Path, edges: list[int]) -> list[PartEdge]:
    by_id = {edge.id: edge for edge in shape.edges}
    if unknown := [str(number) for number in edges if number not in by_id]:
        raise InputError(f"{part.name} has no edge {', '.join(unknown)}: see weldcal part {part}.")
    if edges:
        return [by_id[number] for number in edges]
    concave = [edge for edge in shape.edges if edge.kind == "concave"]
    if not concave:
        raise InputError(f"{part.name} has no concave edge: choose edges with weldcal part {part} and give --edges.")
    concave.sort(key=lambda edge: -edge.length_m)
    return [next((edge for edge in concave if _open_above(shape, edge)), concave[0])]


def _open_above(shape: PartShape, edge: PartEdge) -> bool:
    """Whether the joint at an edge opens upwards, as the part is drawn."""
    try:
        seam = seam_of(shape, SeamSource(edges=(edge.id,)), _joint(edge))
    except WeldcalError:
        return False
    return float(seam.up_P[:, 2].mean()) > OPEN_ABOVE


def _joint(edge: PartEdge) -> str:
    return "v_groove" if edge.angle_rad < NARROW_RAD else "fillet"
