"""Power sources: Modbus TCP against bytes of the specification and an emulator, its faults, and the simulated arc."""

import math
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, VectorLogSink

from weldcal.models.errors import InputError
from weldcal.systems.drivers.power.modbus import ModbusPowerSource, PowerLink, preflight
from weldcal.systems.drivers.power.modbus_client import ModbusClient, ModbusError
from weldcal.systems.drivers.power.register_map import Register, RegisterMap, load_register_map
from weldcal.systems.drivers.sensors.stamps import HostTime
from weldcal.systems.drivers.simulated.power_source import SimulatedArc, SimulatedPowerSource, melting_current_A
from weldcal.tools.emulators.power_source import PowerSourceEmulator
from weldcal.welding.record.schedule import WeldSchedule

SHIPPED = load_register_map("kemppi_dcm")
# one whose values lie apart, in halves of a register, below zero, and in holding registers
SPREAD = RegisterMap(
    name="spread",
    set={
        "current_A": Register(address=2004, scale=500.0 / 65535.0),
        "arc_on": Register(address=2000, bit=3),
        "job": Register(address=2002, bit=8, width=8),
    },
    shown={
        "arc_established": Register(address=100, bit=15),
        "current_A": Register(address=101, scale=0.1, signed=True),
        "voltage_V": Register(address=103, scale=0.01),
    },
    fixed=((Register(address=2002, bit=0, width=4), 9.0),),
)


def served(requests: list[bytes], answers: list[bytes]) -> tuple[int, threading.Thread]:
    """Serve one connection: keep what it sends, and answer with these bytes."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with listener, listener.accept()[0] as connection:
            for answer in answers:
                requests.append(connection.recv(300))
                connection.sendall(answer)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return int(listener.getsockname()[1]), thread


def head(number: int, size: int) -> bytes:
    """The MBAP header: transaction, protocol 0, bytes that follow, unit 17."""
    return bytes([0, number, 0, 0, 0, size, 17])


def test_requests_are_those_of_the_specification() -> None:
    """The examples of MODBUS Application Protocol V1.1b3, sections 6.3, 6.4, 6.6 and 6.12, behind an MBAP header."""
    pdus = [
        ("03006b0003", "0306022b00000064"),
        ("0400080001", "0402000a"),
        ("0600010003", "0600010003"),
        ("100001000204000a0102", "1000010002"),
    ]
    answers = [head(n, 1 + len(a) // 2) + bytes.fromhex(a) for n, (_, a) in enumerate(pdus, start=1)]
    requests: list[bytes] = []
    port, thread = served(requests, answers)
    client = ModbusClient("127.0.0.1", port, unit=17)
    assert client.read(107, 3) == (555, 0, 100)
    assert client.read(8, 1, 4) == (10,)
    client.write(1, [3])
    client.write(1, [10, 258])
    client.close()
    thread.join(5.0)
    assert requests == [head(n, 1 + len(r) // 2) + bytes.fromhex(r) for n, (r, _) in enumerate(pdus, start=1)]


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("00010000000301" + "8302", "refused function 3 with code 2: it does not have this register"),
        ("00010000000501" + "03020005", ""),
        ("00020000000501" + "03020005", "does not speak Modbus TCP"),
        ("485454502f312e31", "does not speak Modbus TCP"),
        ("00010000000301" + "0300", "answered with 0 bytes in place of 2"),
        ("00010000", "closed the connection"),
    ],
)
def test_answers_that_are_none(answer: str, words: str) -> None:
    port, _ = served([], [bytes.fromhex(answer)])
    client = ModbusClient("127.0.0.1", port)
    if not words:
        assert client.read(0, 1) == (5,)
        return
    with pytest.raises(ModbusError, match=re.escape(words)):
        client.read(0, 1)


def test_registers_hold_values_in_their_units() -> None:
    words = SPREAD.words({"current_A": 250.0, "arc_on": 1.0, "job": 12.0, "voltage_V": 3.0})
    assert words == {2000: 8, 2002: 12 << 8 | 9, 2004: 32768}
    assert [list(b) for b in SPREAD.blocks] == [[2002], [2004], [2000]]  # the arc comes after its values
    shown = SPREAD.values([0x8000, 0xFFFF, 7, 2400])
    assert shown == {"arc_established": 1.0, "current_A": pytest.approx(-0.1), "voltage_V": 24.0}
    assert SHIPPED.words({"wire_feed_m_min": 8.04, "voltage_V": math.nan}) == {0: 0b110, 1: 0, 2: 80, 3: 0}


def test_a_map_that_cannot_be_used_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    good = "schema: weldcal power source map\nshown: {arc_established: {address: 1, bit: 0}}\n"
    wrong = {
        "shown: {}": "arc_established is missing",
        good + "extra: 1": "key 'extra' is not known",
        good + "set: {arc_on: {address: 1}}": "is a bit",
        good + "set: {job: {address: 70000}}": "address from 0 to 65535",
        good + "set: {job: {address: 1, bit: 9, width: 8}}": "bits from 0 to 15",
        good + "set: {job: {address: 1, scale: 0}}": "scale must not be 0",
        good + "set: {job: {address: 5}, arc_on: {address: 5, bit: 2}}": "two values are written to register 5",
        good + "set: {jobs: {address: 5}}": "by the names",
    }
    for text, words in wrong.items():
        (tmp_path / "m.yaml").write_text(text if "schema" in text else f"schema: weldcal power source map\n{text}")
        with pytest.raises(InputError, match=words):
            load_register_map(str(tmp_path / "m.yaml"))
    (tmp_path / "m.yaml").write_text(good)
    assert load_register_map(str(tmp_path / "m.yaml")).read_block == range(1, 2)
    with pytest.raises(InputError, match="one of kemppi_dcm"):
        load_register_map("lorch")


def test_a_schedule_that_the_map_cannot_hold_is_refused() -> None:
    config = ModbusPowerSource(host="127.0.0.1")
    config.check_schedule(WeldSchedule(wire_feed_m_min=25.0, voltage_V=24.0, job=3))
    assert config.takes == ("job", "wire_feed_m_min", "voltage_V")
    with pytest.raises(InputError, match="wire_feed_m_min 30 is out of the range"):
        config.check_schedule(WeldSchedule(wire_feed_m_min=30.0))


@pytest.fixture
def source() -> Iterator[PowerSourceEmulator]:
    with PowerSourceEmulator(SHIPPED, SimulatedPowerSource(noise=0.0, ignition_s=0.05)) as emulator:
        yield emulator


def linked(source: PowerSourceEmulator, registers: RegisterMap = SHIPPED) -> PowerLink:
    return PowerLink(ModbusPowerSource(host="127.0.0.1", port=source.port), registers, HostTime())


def until(true: Callable[[], object], seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.005)
    return False


def test_set_values_and_arc_reach_the_source_and_come_back(source: PowerSourceEmulator) -> None:
    link = linked(source)
    keeps = {"job": 7.0, "wire_feed_m_min": 8.0, "voltage_V": 24.5, "current_A": math.nan}

    def burning() -> bool:
        link.command(True, keeps)
        return link.shown["arc_established"] > 0.5

    assert until(burning)
    assert [source.set_value(n) for n in ("job", "wire_feed_m_min", "voltage_V")] == [7.0, 8.0, pytest.approx(24.5)]
    assert link.shown["voltage_V"] == pytest.approx(24.5)
    assert link.shown["current_A"] == round(melting_current_A(8.0, 15.0))
    assert link.fault(time.monotonic()) is None
    # a cell that gives no command any more
    assert until(lambda: not source.asked, 1.0)
    assert until(lambda: link.shown["arc_established"] < 0.5)
    link.close()
    assert source.holding[:4] == [0, 0, 0, 0]
    assert set(source.requests) == {4, 16}


def test_the_arc_ends_with_its_process(source: PowerSourceEmulator) -> None:
    """A source with a watchdog: the client is gone without a word."""
    client = ModbusClient("127.0.0.1", source.port)
    client.write(0, [0b100000111])
    assert source.asked
    client.close()
    assert until(lambda: not source.asked, 1.5)


@pytest.mark.parametrize(
    ("happens", "words"),
    [
        ({"error": 12.0}, "POWER SOURCE: it reports error 12"),
        ({"silent": True}, "does not answer|no answer from"),
        ({"refuses": 4}, "refused function"),
    ],
)
def test_faults_of_a_source_are_said(source: PowerSourceEmulator, happens: dict[str, float], words: str) -> None:
    link = linked(source)
    assert link.fault(time.monotonic()) is None
    for name, value in happens.items():
        setattr(source, name, value)
    found: list[str] = []

    def said() -> bool:
        found[:] = [link.fault(time.monotonic()) or ""]
        return bool(found[0])

    assert until(said)
    assert re.search(words, found[0])
    source.silent = False
    link.close()


def test_preflight_reads_and_writes_nothing(source: PowerSourceEmulator) -> None:
    config = ModbusPowerSource(host="127.0.0.1", port=source.port)
    assert [check.ok for check in preflight(config).checks] == [True]
    source.error = 5.0
    assert "reports error 5" in preflight(config).checks[0].operator_action
    assert set(source.requests) == {4}
    with pytest.raises(InputError, match=r"Write power_source\.host"):
        preflight(ModbusPowerSource())
    with pytest.raises(InputError, match="does not answer"):
        preflight(ModbusPowerSource(host="127.0.0.1", port=1))


def simulated(config: SimulatedPowerSource, values: list[float], on: float = 1.0) -> list[VectorLogSink]:
    builder = DiagramBuilder()
    arc = builder.AddSystem(SimulatedArc(config))
    for name, numbers in (("process_on", [on]), ("set_values", values)):
        constant = builder.AddSystem(ConstantVectorSource(np.array(numbers)))
        builder.Connect(constant.get_output_port(), arc.GetInputPort(name))
    sinks = [LogVectorOutput(arc.GetOutputPort(name), builder, 0.008) for name in ("arc_established", "arc_values")]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.0)
    return [sink.FindLog(simulator.get_context()) for sink in sinks]


def test_the_simulated_arc_burns_after_its_ignition_and_melts_its_wire() -> None:
    established, values = simulated(SimulatedPowerSource(ignition_s=0.2), [math.nan, 8.0, 26.0, math.nan])
    lit = established.sample_times()[np.flatnonzero(established.data()[0] > 0.5)[0]]
    assert 0.2 <= lit <= 0.2 + 0.017
    current, voltage = values.data()[:, values.sample_times() > 1.0]
    # 8 m/min of a 1.2 mm wire at a stick-out of 15 mm: the melting law, solved backwards
    feed = 0.3 * current.mean() + 5.0e-5 * 15.0 * current.mean() ** 2
    assert feed == pytest.approx(8000.0 / 60.0, rel=0.01)
    assert voltage.mean() == pytest.approx(26.0, rel=0.01)
    assert 0.015 < voltage.std() / voltage.mean() < 0.025
    assert not simulated(SimulatedPowerSource(), [math.nan] * 4, on=0.0)[1].data().any()
