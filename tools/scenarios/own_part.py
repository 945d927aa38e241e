"""Puts a user's part, and a copy of the tool to change, into a new cell."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartEdge, PartShape
from weldcal.systems.scenario.schema import PoseConfig, Scenario, SeamConfig, ToolFile, WorkpieceConfig

TOOL = "tool.yaml"
NARROW_RAD = np.deg2rad(75.0)  # a V is narrower than this, a fillet wider
PLACE_M = (0.65, 0.0)  # of the part's middle, where the demo's plate lies


def add_part(scenario: Scenario, folder: Path, part: Path, edges: list[int], joint: str | None) -> None:
    """Copy a part's file into the cell's folder, and make it the scenario's workpiece, standing on the table.

    Without `edges` the longest concave one is the seam; without `joint` its angle says which joint it is.

    Raises:
        InputError: the part cannot be read, has no such edge, or no concave one.
    """
    shape = read_shape(part)
    chosen = _chosen(shape, part, edges)
    name = joint or ("v_groove" if chosen[0].angle_rad < NARROW_RAD else "fillet")
    low, high = shape.mesh.bounds
    x, y = np.array(PLACE_M) - 0.5 * (low + high)[:2]
    guess = PoseConfig([round(float(v), 4) for v in (x, y, scenario.calibration.table_z_m - low[2])])
    scenario.workpiece = WorkpieceConfig(
        file=part.name, seams=[SeamConfig(edges=[edge.id for edge in chosen])], joint=name, pose_guess=guess
    )
    shutil.copyfile(part, folder / part.name)


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
    lengths: NDArray[np.float64] = np.array([edge.length_m for edge in concave])
    return [concave[int(lengths.argmax())]]
