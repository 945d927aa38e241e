"""Makes a scenario's workpiece from its file: the part as drawn with its seam, and the part as it was made."""

import dataclasses as dc
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.models.workpieces.part import Part, bowed
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.seams import JOINTS
from weldcal.models.workpieces.shape import UNITS_M
from weldcal.systems.scenario.schema import SeamConfig, WorkpieceConfig

OF_PLATES = ("bend_radius_mm", "hole_from_mm")


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
            f"workpiece.seams is missing: write seams: [{{edges: [1]}}] with a number from weldcal part {Path(spec.file).name}, or "
            "seams: [{polyline: seam.csv}]."
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
    first, *others = (dc.replace(seam_of(shape, source(seam), spec.joint), feel=seam.feel) for seam in spec.seams)
    return Part(shape, first, tuple(others))


def made(part: Part, spec: WorkpieceConfig, rng: np.random.Generator) -> Part:
    """The part as made: bowed by groove_error.translation_mm in a direction drawn from the run's seed."""
    amplitude = 1e-3 * spec.groove_error.translation_mm
    if amplitude == 0.0:
        return part
    turn = rng.uniform(-math.pi, math.pi)
    direction: NDArray[np.float64] = np.array([math.cos(turn), math.sin(turn), 0.0])
    return bowed(part, amplitude, direction)
