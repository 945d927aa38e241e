"""What all laser profilers by wire share: their configuration, and the system that asks for profiles."""

import dataclasses as dc
import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from weldcal.systems.drivers.sensors.acquisition import Acquisition, Garbage, Rules, Source
from weldcal.systems.drivers.sensors.stamps import DiagramTime
from weldcal.systems.drivers.sensors.watch import watch
from weldcal.systems.drivers.simulated.rendered_profiler import RenderedProfiler
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import ProfileScan

Profile = NDArray[np.float64]
PERIOD_S = 0.008
FAR = 1.5
FEWEST_POINTS = 10


@dc.dataclass
class WiredProfiler(RenderedProfiler):
    """The keys of all profilers by wire, with those of the simulated one: its nominal pose, range, width and noise."""

    SIMULATED: ClassVar[bool] = False
    unit: str = "mm"  # of the points: m or mm
    scan_timeout_s: float = 2.0
    latency_s: float = 0.0


def checked_profile(points: NDArray[Any], metres: float, config: RenderedProfiler) -> Profile:
    """Points (n, 2) [x, z] m, NaN where nothing was measured.

    Raises:
        Garbage: too few points, or they lie beyond the profiler's range, as points in another unit do.
    """
    profile = np.asarray(points, dtype=np.float64) * metres
    if profile.ndim != 2 or profile.shape[1] != 2:
        raise Garbage(f"a profile is (n, 2), and this one is {profile.shape}")
    profile[~np.isfinite(profile).all(axis=1)] = np.nan
    z = profile[np.isfinite(profile[:, 1]), 1]
    if z.size < FEWEST_POINTS:
        raise Garbage(f"the profile has {z.size} points; look whether something is in the profiler's range")
    if not 0.0 < np.median(z) <= FAR * 1e-3 * config.farthest_mm:
        raise Garbage(
            f"the middle of the profile is {np.median(z):.3g} m away: set profiler.unit to the unit of its points"
        )
    return profile


class WiredProfiles(LeafSystem):
    """Asks the profiler for one profile per trigger.

    .. pydrake_system::

        name: WiredProfiles
        input_ports:
        - trigger
        output_ports:
        - profile

    Ports as those of the simulated profiler. The capture time is that of the profile's stamp, and at the earliest that of its
    trigger.
    """

    def __init__(self, acquisition: Acquisition[Profile], waits: bool = False) -> None:
        super().__init__()
        self.acquisition, self._waits = acquisition, waits
        self._times, self._shown = DiagramTime(), ProfileScan()
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        state = self.DeclareDiscreteState([0.0, 0.0, 0.0])  # number asked for, its time, number shown
        ticket = {self.discrete_state_ticket(state)}
        self.DeclareAbstractOutputPort("profile", lambda: AbstractValue.Make(ProfileScan()), self._output, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        now = context.get_time()
        self._times.add(time.monotonic(), now)
        asked, asked_at, shown = context.get_discrete_state_vector().value()
        wanted = int(self._trigger.Eval(context)[0])
        if wanted > asked:
            asked, asked_at = float(wanted), now
            self.acquisition.request(wanted)
        if asked > shown:
            number = int(asked)
            found = self.acquisition.wait_for_answer(number) if self._waits else self.acquisition.answer(number)
            if found is not None:
                self._shown = ProfileScan(number, max(self._times.at(found.stamp.captured), asked_at), found.datum)
                shown = asked
        discrete.set_value([asked, asked_at, shown])

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self._shown if context.get_discrete_state_vector()[2] > 0.5 else ProfileScan())


def acquire_profiles(config: WiredProfiler, source: Source[Profile]) -> Acquisition[Profile]:
    """The acquisition of a profiler's profiles, not started yet."""
    rules = Rules(late_s=float("inf"), answer_s=config.scan_timeout_s)
    return Acquisition(source, rules, kept=2, latency_s=config.latency_s)


def add_profiler(config: WiredProfiler, source: Source[Profile], build: StationBuild, start_s: float = 10.0) -> None:
    """Start the acquisition and add the profiler's system with its ports to the station.

    Raises:
        DeviceFault: the profiler does not answer.
    """
    acquisition = acquire_profiles(config, source)
    acquisition.start(start_s, first_frame=False)
    watch(build, acquisition, "profiler")
    system = build.builder.AddSystem(WiredProfiles(acquisition, build.may_wait))
    system.set_name("profiler")
    build.inputs["profiler.trigger"] = system.GetInputPort("trigger")
    build.outputs["profiler.profile"] = system.GetOutputPort("profile")
