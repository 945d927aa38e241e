"""A list of poses with the reading that is used, and the other readings that its numbers allow."""

from dataclasses import dataclass

from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.models.arrays import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseList:
    """Poses of a file, read.

    Attributes:
        source: the file's name.
        X: poses (n, 4, 4), positions in the file's own unit.
        ids: names of the rows (n), or empty.
        times: times of the rows (n) s, or None.
        unit: the unit that the form fixes, m or mm, or empty.
        read_as: a phrase for the user.
        readings: all readings that the numbers allow, the used one first; empty where there is one.
        left_out: rows without a pose: name and reason.
    """

    source: str
    X: Array
    ids: tuple[str, ...] = ()
    times: Array | None = None
    unit: str = ""
    read_as: str = ""
    readings: tuple[PoseReading, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
