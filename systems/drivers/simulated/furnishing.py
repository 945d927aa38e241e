"""The objects that a job adds to the simulated world, with true poses drawn from the run's seed."""

from collections.abc import Sequence
from dataclasses import dataclass

from weldcal.models.robots import BaseCircle
from weldcal.systems.drivers.simulated.profiler_world import ProfilerFixture
from weldcal.systems.drivers.simulated.second_arm import PlacedArm
from weldcal.systems.drivers.simulated.world import Fittings


@dataclass(frozen=True, eq=False, kw_only=True)
class Furnishing:
    """Bodies for `build_world`, and `parts` that drivers look up by type (see StationBuild).

    `contacts_read`: a device reads the plant's contact results.
    """

    fittings: Sequence[Fittings] = ()
    second: PlacedArm | None = None
    foot: BaseCircle | None = None
    profiler: ProfilerFixture | None = None
    time_step_s: float = 0.002  # of the plant: as fine as what is touched asks for
    parts: Sequence[object] = ()
    contacts_read: bool = False
