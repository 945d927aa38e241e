"""Every address that an operator may mistype is one sentence; those that exist are taken as they are."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from weldcal.systems.addresses import AddressError, controller_address, is_loopback, loopback_address, own_address
from weldcal.systems.drivers.ur.wire.line import SocketLine
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.run import chosen_robot
from weldcal.tools.emulators.ur.main import run_emulator

WRONG = {
    "999.1.1.1": "is not an IPv4 address",
    "192.168.1": "is not an IPv4 address",
    "192.168.1.1.1": "is not an IPv4 address",
    "192.168.056.101": "is not an IPv4 address",
    "3232249957": "is not an IPv4 address",  # the system's look-up would take it for 192.168.56.101
    "0x7f.1": "is not an IPv4 address",
    "0x7f000001": "is not an IPv4 address",
    "-1.2.3.4": "is not an IPv4 address",
    "fe80::1": "is an IPv6 address",
    "[::1]": "is an IPv6 address",
    "::ffff:10.0.0.1": "is an IPv6 address",
    "192.168.56.101 ": "has a space in it",
    " 192.168.56.101": "has a space in it",
    "192.168. 56.101": "has a space in it",
    "robot\n": "has a space in it",
    "http://192.168.56.101": "a URL or a path",
    "192.168.56.101/24": "a URL or a path",
    "192.168.56.101:30002": "has a port",
    "my robot": "has a space in it",
    "-robot": "neither an IP address nor a host name",
    "robot..lab": "neither an IP address nor a host name",
    "röbot": "neither an IP address nor a host name",
    "user@robot": "neither an IP address nor a host name",
    "x" * 64: "neither an IP address nor a host name",
    "0.0.0.0": "not the address of one machine",
    "255.255.255.255": "not the address of one machine",
    "224.0.0.1": "not the address of one machine",
    "": "Give the robot's host name or IP address",
    "  ": "Give the robot's host name or IP address",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_address_is_one_sentence(text: str) -> None:
    with pytest.raises(AddressError, match=WRONG[text]) as refusal:
        controller_address(text)
    said = str(refusal.value)
    assert said.endswith(".")
    assert "\n" not in said
    assert said.count(". ") - text.count(". ") == 0


@pytest.mark.parametrize(
    "text", ["192.168.56.101", "127.0.0.9", "ur10e", "ur-2021.lab.example", "ur_10", "10-0-0-1.lab"]
)
def test_an_address_or_a_host_name_is_taken_as_it_is(text: str) -> None:
    assert controller_address(text) == text


def test_a_connection_a_run_and_the_check_refuse_before_any_work() -> None:
    with pytest.raises(AddressError, match="is not an IPv4 address"):
        SocketLine("192.168.1", 29999, "Dashboard", 0.1)
    scenario = load_scenario("straight_groove")
    with pytest.raises(AddressError, match="has a port"), chosen_robot("192.168.1.5:29999", scenario):
        pass
    for word in ("emulated@192.168.1.5", "emulated@127.evil.example", "emulated@127.1"):
        with pytest.raises(AddressError, match="listens on loopback only"), chosen_robot(word, scenario):
            pass
    answer = CliRunner().invoke(app, ["check-robot", "999.1.1.1"])
    assert answer.exit_code == 1
    assert "'999.1.1.1' is not an IPv4 address" in answer.stderr


@pytest.mark.parametrize("host", ["127.evil.example", "0.0.0.0", "127.1", "::1", "192.168.1.1", ""])
def test_the_emulator_listens_on_loopback_only(host: str) -> None:
    with pytest.raises(AddressError, match=r"loopback only; give an address 127\.x\.y\.z"):
        run_emulator(host=host)


def test_an_address_to_listen_on_is_an_ip_address() -> None:
    assert own_address("localhost") == "127.0.0.1"
    assert own_address("::1") == "::1"
    assert own_address("0.0.0.0") == "0.0.0.0"
    assert loopback_address("127.0.0.41") == "127.0.0.41"
    for text in ("my-computer", "192.168.1", "0.0.0.0:80", ""):
        with pytest.raises(AddressError, match="is not an IP address"):
            own_address(text)
    assert is_loopback("127.3.4.5")
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("127.evil.example")
