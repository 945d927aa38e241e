"""What all laser profilers by wire share: their configuration, the checks of a profile, and their system."""

import dataclasses as dc
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from weldcal.systems.drivers.sensors.acquisition import Acquisition, Garbage, Rules, Source
from weldcal.systems.drivers.sensors.watch import OnTrigger, begin
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import ProfileScan

Profile = NDArray[np.float64]
PERIOD_S = 0.008  # two periods of the commands: a profile is delayed by at most this
FAR = 1.5  # a choice: allows a mount that is half farther off than planned; a wrong unit is a factor of 10 or more
FEWEST_POINTS = 10


@dc.dataclass(kw_only=True)
class WiredProfiler(RenderedProfiler):
    """The keys of all profilers by wire, with those of the simulated one: its nominal pose, range, width and noise."""

    SIMULATED: ClassVar[bool] = False
    unit: str = "mm"  # of the points: m or mm
    heights_from_mm: float | None = None  # where z grows towards the sensor: the sensor's distance at z = 0
    scan_timeout_s: float = 2.0
    latency_s: float = 0.0


def checked_profile(points: NDArray[Any], metres: float, config: WiredProfiler) -> Profile:
    """Points (n, 2) [x, z] m, NaN where nothing was measured.

    Raises:
        Garbage: too few points, or they lie beyond the profiler's range, as points in another unit do.
    """
    profile = np.asarray(points, dtype=np.float64) * metres
    if profile.ndim != 2 or profile.shape[1] != 2:
        raise Garbage(f"a profile is (n, 2), and this one is {profile.shape}")
    if config.heights_from_mm is not None:
        profile[:, 1] = 1e-3 * config.heights_from_mm - profile[:, 1]
    profile[~np.isfinite(profile).all(axis=1)] = np.nan
    z = profile[np.isfinite(profile[:, 1]), 1]
    if z.size < FEWEST_POINTS:
        raise Garbage(f"the profile has {z.size} points; look whether something is in the profiler's range")
    if not 0.0 < np.median(z) <= FAR * 1e-3 * config.farthest_mm:
        raise Garbage(
            f"the middle of the profile is {np.median(z):.3g} m away: set profiler.unit to the unit of its points, and"
            " profiler.heights_from_mm where z grows towards the sensor"
        )
    return profile


def acquire_profiles(config: WiredProfiler, source: Source[Profile]) -> Acquisition[Profile]:
    """Return the acquisition of a profiler's profiles, not started yet."""
    rules = Rules(late_s=float("inf"), answer_s=config.scan_timeout_s)
    return Acquisition(source, rules, kept=2, latency_s=config.latency_s)


def add_profiler(config: WiredProfiler, source: Source[Profile], build: StationBuild) -> None:
    """Start the acquisition and add the profiler's system with its ports to the station.

    Raises:
        DeviceFault: the profiler does not answer.
    """
    acquisition = acquire_profiles(config, source)
    begin(build, acquisition, "profiler", first_frame=False)
    system = OnTrigger(acquisition, "profile", ProfileScan, PERIOD_S, build.may_wait)
    build.add("profiler", system, "profiler.trigger", "profiler.profile")
