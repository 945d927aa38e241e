"""Simulated power source: ignition, and current and voltage that follow the set values."""

import dataclasses as dc
import math
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from weldcal.models.arrays import Array
from weldcal.systems.drivers.config import DriverConfig, check_range
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.welding.record.schedule import VALUES

PERIOD_S = 0.008  # two periods of the commands: a real source reports no faster
# Melting of a 1.2 mm plain steel wire: feed = alpha I + beta (stick-out) I^2; J. Norrish, Advanced Welding Processes
ALPHA_MM_S_A, BETA_S_A2 = 0.3, 5.0e-5
PORTS = tuple(f"power_source.{name}" for name in ("process_on", "set_values", "arc_established", "arc_values"))
"""The ports that every power source's driver exports."""


@dc.dataclass(kw_only=True)
class SimulatedPowerSource(DriverConfig):
    """`!SimulatedPowerSource`: a power source with an arc of its own set values or those of welding.schedule."""

    FOR: ClassVar[tuple[str, ...]] = ("power_source",)
    SIMULATED: ClassVar[bool] = True

    current_A: float = 180.0  # set by hand, where the schedule sets neither wire feed nor current
    voltage_V: float = 24.0  # set by hand, where the schedule sets none
    ignition_s: float = 0.12  # from the torch to the arc
    response_s: float = 0.05  # time constant of current and voltage
    stick_out_mm: float = 15.0  # of the wire, 1.2 mm plain steel, whose feed gives the current
    noise: float = 0.02  # standard deviation of measured current and voltage, as a share

    @property
    def reports_arc(self) -> bool:
        """See DriverConfig."""
        return True

    @property
    def takes(self) -> tuple[str, ...]:
        """See DriverConfig."""
        return ("job", *VALUES)

    def torch_delay_s(self) -> float:
        """See DriverConfig."""
        return self.ignition_s

    def aim(self, set_values: Array) -> Array:
        """Current A and voltage V, (2,), that set values (4,) as in SET_VALUES lead to."""
        _, feed, voltage, current = set_values
        if not math.isfinite(current):
            current = self.current_A if not math.isfinite(feed) else melting_current_A(feed, self.stick_out_mm)
        return np.array([current, voltage if math.isfinite(voltage) else self.voltage_V])


def melting_current_A(feed_m_min: float, stick_out_mm: float) -> float:
    """The current that melts the wire as fast as it is fed."""
    square, feed_mm_s = BETA_S_A2 * stick_out_mm, 1e3 * feed_m_min / 60.0
    return (math.sqrt(ALPHA_MM_S_A**2 + 4.0 * square * feed_mm_s) - ALPHA_MM_S_A) / (2.0 * square)


class SimulatedArc(LeafSystem):
    """The arc of a simulated power source.

    .. pydrake_system::

        name: SimulatedArc
        input_ports:
        - process_on
        - set_values
        output_ports:
        - arc_established
        - arc_values

    `process_on` (1; unconnected: off) asks for the torch; `set_values` (4) job, wire feed m/min, voltage V, current A,
    NaN where not set. `arc_established` (1); `arc_values` (2) measured current A and voltage V, 0 without an arc.
    """

    def __init__(self, config: SimulatedPowerSource, seed: int = 0) -> None:
        super().__init__()
        self._config, self._seed = config, seed
        self._process = self.DeclareVectorInputPort("process_on", 1)
        self._set = self.DeclareVectorInputPort("set_values", 4)
        self._arc = self.DeclareDiscreteState(1)
        self._shown = self.DeclareDiscreteState(2)
        self._inside = self.DeclareDiscreteState([math.nan, 0.0, 0.0])  # since when the torch is on, s; true A and V
        self.DeclareStateOutputPort("arc_established", self._arc)
        self.DeclareStateOutputPort("arc_values", self._shown)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        now, config = context.get_time(), self._config
        since, *values = discrete.value(self._inside)
        on = self._process.HasValue(context) and self._process.Eval(context)[0] > 0.5
        since = math.nan if not on else now if math.isnan(since) else since
        burning = on and now - since >= config.ignition_s
        true, noisy = np.zeros(2), np.zeros(2)
        if burning:
            given = self._set.Eval(context) if self._set.HasValue(context) else np.full(4, math.nan)
            follow = 1.0 - math.exp(-PERIOD_S / config.response_s) if config.response_s > 0.0 else 1.0
            true = np.array(values) + follow * (config.aim(given) - values)
            # the same numbers at the same time, whenever Drake asks
            rng = np.random.default_rng((self._seed, round(now / PERIOD_S)))
            noisy = true * (1.0 + config.noise * rng.standard_normal(2))
        discrete.set_value(self._arc, [float(burning)])
        discrete.set_value(self._shown, noisy)
        discrete.set_value(self._inside, [since, *true])


def ApplyDriverConfig(config: SimulatedPowerSource, build: StationBuild) -> None:
    """Add the arc and its ports."""
    for name, most in (("ignition_s", 2.0), ("response_s", 2.0), ("noise", 0.5)):
        check_range(f"power_source.{name}", getattr(config, name), 0.0, most)
    for name, most in (("current_A", 2000.0), ("voltage_V", 100.0), ("stick_out_mm", 50.0)):
        check_range(f"power_source.{name}", getattr(config, name), 1.0, most)
    build.add("power_source", SimulatedArc(config, int(build.rng.integers(2**31))), *PORTS)
