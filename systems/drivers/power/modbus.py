"""Power source over Modbus TCP: set values and arc out, arc, current and voltage back, beside the control loop."""

import dataclasses as dc
import math
import threading
import time
from collections.abc import Mapping
from typing import ClassVar

from pydrake.systems.framework import Context, DiscreteValues, EventStatus

from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import DriverConfig, check_range
from weldcal.systems.drivers.power.modbus_client import READ_HOLDING, READ_INPUT, ModbusClient, ModbusError
from weldcal.systems.drivers.power.register_map import RegisterMap, load_register_map
from weldcal.systems.drivers.sensors.preflight import Sensed
from weldcal.systems.drivers.sensors.stamps import CellTime, cell_time
from weldcal.systems.drivers.sensors.watch import watch
from weldcal.systems.drivers.simulated.power_source import PORTS
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.drivers.ur.readiness.preflight import Check
from weldcal.systems.leaf_system import LeafSystem
from weldcal.welding.record.schedule import VALUES, WeldSchedule

PERIOD_S = 0.008  # two periods of the commands
EXCHANGE_S = 0.02  # a choice: 50 exchanges a second; a source's registers change no faster
STALE_S = 0.25  # a choice: twice the longest tick of a weld; the arc of an older command is turned off
SILENT_S = 0.3  # a choice: as the longest time without a view of the tag
TROUBLE_S = 0.2  # a choice: for which a power source may be not ready, as when the robot has just become so
NAMES = ("job", "wire_feed_m_min", "voltage_V", "current_A")  # of the port set_values


@dc.dataclass(kw_only=True)
class ModbusPowerSource(DriverConfig):
    """`!ModbusPowerSource`: a power source with a Modbus TCP interface, by the map of its registers."""

    FOR: ClassVar[tuple[str, ...]] = ("power_source",)

    host: str = ""  # address of its interface
    port: int = 502  # of Modbus TCP
    unit: int = 1  # unit identifier of the requests
    map: str = dc.field(default="kemppi_dcm", metadata={"file": True})  # register map: of the package, or a YAML file
    ignition_s: float = 0.5  # from the torch to the arc at most, with gas pre-flow, on top of the usual 2 s

    @property
    def reports_arc(self) -> bool:
        """See DriverConfig."""
        return True

    def torch_delay_s(self) -> float:
        """See DriverConfig."""
        return self.ignition_s

    def checked(self) -> RegisterMap:
        """The register map. Raises InputError for keys that cannot be used."""
        if not self.host:
            raise InputError("Write power_source.host: the address of the power source's Modbus TCP interface.")
        check_range("power_source.port", self.port, 1, 65535)
        check_range("power_source.unit", self.unit, 0, 255)
        check_range("power_source.ignition_s", self.ignition_s, 0.0, 10.0)
        return load_register_map(self.map)

    @property
    def takes(self) -> tuple[str, ...]:
        """See DriverConfig."""
        return tuple(name for name in NAMES if name in self.checked().set)

    def check_schedule(self, schedule: WeldSchedule) -> None:
        """See DriverConfig."""
        for name, register in self.checked().set.items():
            given = (schedule.job,) if name == "job" else schedule.extremes(name) if name in VALUES else ()
            wrong = [value for value in given if value is not None and not register.holds(value)]
            if wrong:
                raise InputError(f"welding.schedule: {name} {wrong[0]:g} is out of the range of the map {self.map}.")

    def connected(self) -> ModbusClient:
        """A connection. Raises InputError where the power source does not answer."""
        try:
            return ModbusClient(self.host, self.port, self.unit)
        except ModbusError as error:
            raise InputError(
                f"The power source {error} Switch it on, and look at power_source.host and port."
            ) from None


def shown_values(client: ModbusClient, registers: RegisterMap) -> dict[str, float]:
    """What the power source shows now. Raises ModbusError."""
    block = registers.read_block
    return registers.values(
        client.read(block.start, len(block), READ_INPUT if registers.input_registers else READ_HOLDING)
    )


def trouble(shown: Mapping[str, float]) -> str | None:
    """What keeps a power source from welding, by its values; None where nothing does."""
    if (number := shown.get("error", 0.0)) != 0.0:
        return f"it reports error {number:g}"
    return "it is not ready" if shown.get("ready", 1.0) < 0.5 else None


class PowerLink:
    """The connection, in a thread of its own: each exchange writes the newest command and reads what is shown.

    The arc is on only while commands are fresh, so that a cell that stops turns it off. It is no safety function.

    Raises:
        InputError: the power source does not answer.
    """

    def __init__(self, config: ModbusPowerSource, registers: RegisterMap, time_: CellTime) -> None:
        self.time, self._map, self._client = time_, registers, config.connected()
        self._where = f"{config.host}:{config.port}"
        self._command: tuple[float, bool, Mapping[str, float]] = (-math.inf, False, {})
        self._problem, self._ends, self._toggle = "", False, 0.0
        self.shown: dict[str, float] = {}
        try:
            self._exchange(time.monotonic())
        except ModbusError as error:
            self._client.close()
            raise InputError(f"The power source {error} Compare power_source.map with its manual.") from None
        self._heard = self._well_at = time_.now()
        self._thread = threading.Thread(target=self._run, daemon=True, name="power source")
        self._thread.start()

    def command(self, on: bool, values: Mapping[str, float]) -> None:
        """Give the newest command. Never waits."""
        self._command = (time.monotonic(), on, values)

    def _run(self) -> None:
        try:
            while not self._ends:
                begin = time.monotonic()
                self._exchange(begin)
                self._heard = self.time.now()
                time.sleep(max(EXCHANGE_S - (time.monotonic() - begin), 0.0))
            for block in self._map.blocks:
                self._client.write(block.start, [0] * len(block))
        except ModbusError as error:
            self._problem = str(error)
        finally:
            self._client.close()

    def _exchange(self, now: float) -> None:
        given_at, on, values = self._command
        self._toggle = 1.0 - self._toggle
        fresh = now - given_at < STALE_S
        words = self._map.words({**values, "arc_on": float(on and fresh), "watchdog": self._toggle})
        for block in self._map.blocks:
            self._client.write(block.start, [words[address] for address in block])
        self.shown = shown_values(self._client, self._map)

    def fault(self, now: float) -> str | None:
        """See SelfTestingDevice."""
        if self._problem:
            return f"POWER SOURCE: {self._problem} Check its network cable and supply, and start again."
        if now - self._heard > SILENT_S:
            silent = 1e3 * (now - self._heard)
            return (
                f"POWER SOURCE: no answer from {self._where} for {silent:.0f} ms; check the network cable, start again."
            )
        why = trouble(self.shown)
        self._well_at = now if why is None else self._well_at
        if now - self._well_at > TROUBLE_S:
            return f"POWER SOURCE: {why}; look at its display, remove the cause, and start again."
        return None

    def excuse(self, seconds: float) -> None:
        """See SelfTestingDevice."""
        self._heard += seconds
        self._well_at += seconds

    def close(self) -> None:
        """See SelfTestingDevice: the arc off, then the connection."""
        self._ends = True
        self._thread.join(3.0)


class ModbusPowerSourcePorts(LeafSystem):
    """The ports of a power source by Modbus.

    .. pydrake_system::

        name: ModbusPowerSourcePorts
        input_ports:
        - process_on
        - set_values
        output_ports:
        - arc_established
        - arc_values

    As those of the simulated power source. `arc_values` are NaN where the map has none.
    """

    def __init__(self, link: PowerLink) -> None:
        super().__init__()
        self._link = link
        self._process = self.DeclareVectorInputPort("process_on", 1)
        self._set = self.DeclareVectorInputPort("set_values", len(NAMES))
        self._arc = self.DeclareDiscreteState(1)
        self._values = self.DeclareDiscreteState([math.nan, math.nan])
        self.DeclareStateOutputPort("arc_established", self._arc)
        self.DeclareStateOutputPort("arc_values", self._values)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._read)
        self.DeclarePeriodicPublishEvent(PERIOD_S, 0.0, self._send)

    def _read(self, context: Context, discrete: DiscreteValues) -> None:
        shown = self._link.shown
        discrete.set_value(self._arc, [shown["arc_established"]])
        discrete.set_value(self._values, [shown.get(name, math.nan) for name in ("current_A", "voltage_V")])

    def _send(self, context: Context) -> EventStatus:
        on = self._process.HasValue(context) and bool(self._process.Eval(context)[0] > 0.5)
        values = self._set.Eval(context) if self._set.HasValue(context) else [math.nan] * len(NAMES)
        self._link.command(on, dict(zip(NAMES, map(float, values), strict=True)))
        return EventStatus.Succeeded()


def preflight(config: ModbusPowerSource) -> Sensed:
    """Read the power source once. Raises InputError for keys that cannot be used, or where it does not answer."""
    registers, client = config.checked(), config.connected()
    try:
        shown = shown_values(client, registers)
    except ModbusError as error:
        action = f"The power source {error} Compare power_source.map with its manual."
        return Sensed((Check("registers", False, "not readable", action),))
    finally:
        client.close()
    why = trouble(shown) or ("an arc is established" if shown["arc_established"] > 0.5 else None)
    words = ", ".join(f"{name} {value:g}" for name, value in shown.items())
    action = "" if why is None else f"The power source at {config.host}: {why}. Look at its display, then at the map."
    return Sensed((Check("registers", why is None, words, action),))


def ApplyDriverConfig(config: ModbusPowerSource, build: StationBuild) -> None:
    """Connect to the power source, and add its ports; its faults become the robot's."""
    link = PowerLink(config, config.checked(), cell_time(build))
    watch(build, link, "power_source")
    build.add("power_source", ModbusPowerSourcePorts(link), *PORTS)
