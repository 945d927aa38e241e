"""Checks the network addresses that an operator gives, and names what is wrong with one."""

import ipaddress
import re

from weldcal.models.errors import InputError

_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9a-fA-F]*")  # what the system's look-up would take for part of an IPv4 address
_WITH_PORT = re.compile(r"[^:]+:[0-9]+")


class AddressError(InputError):
    """Text that is not a network address."""


def controller_address(text: str) -> str:
    """Return the IPv4 address, or the host name, of a robot's controller.

    Raises:
        AddressError: with the reason and an example.
    """
    word, give = text, "give the IP address that the pendant shows, such as 192.168.56.101"
    if not word.strip():
        raise AddressError("Give the robot's host name or IP address, such as 192.168.56.101.")
    if "/" in word:
        raise AddressError(f"'{word}' is not a robot's address but a URL or a path: {give}.")
    if any(c.isspace() or not c.isprintable() for c in word):
        raise AddressError(f"{word!r} is not a robot's address, because it has a space in it: {give}.")
    try:
        address = ipaddress.ip_address(word.strip("[]"))
    except ValueError:
        return _name(word, give)
    if address.version == 6:
        raise AddressError(f"'{word}' is an IPv6 address, and a UR controller answers on IPv4 only: {give}.")
    if address.is_unspecified or address.is_multicast or int(address) == 0xFFFFFFFF:
        raise AddressError(f"'{word}' is not the address of one machine: {give}.")
    return str(address)


def _name(word: str, give: str) -> str:
    if _WITH_PORT.fullmatch(word):
        raise AddressError(f"'{word}' has a port: {give}, without a port.")
    labels = word.removesuffix(".").split(".")
    if _NUMBER.fullmatch(labels[-1]):
        raise AddressError(f"'{word}' is not an IPv4 address, which is four numbers from 0 to 255: {give}.")
    if len(word) > 253 or not all(_LABEL.fullmatch(label) for label in labels):
        raise AddressError(f"'{word[:60]}' is neither an IP address nor a host name: {give}.")
    return word


def own_address(text: str) -> str:
    """Return an IP address to listen on, IPv4 or IPv6; `localhost` is 127.0.0.1.

    Raises:
        AddressError: with an example.
    """
    if text == "localhost":
        return "127.0.0.1"
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise AddressError(
            f"'{text[:60]}' is not an IP address: give --host as an address of this machine, such as 127.0.0.1, or"
            " 0.0.0.0."
        ) from None


def is_loopback(text: str) -> bool:
    """Return whether only this machine can reach that address."""
    try:
        return ipaddress.ip_address(text).is_loopback
    except ValueError:
        return text == "localhost"


def loopback_address(text: str) -> str:
    """Return an IPv4 address 127.x.y.z.

    Raises:
        AddressError: it is another address, or none.
    """
    try:
        address = ipaddress.IPv4Address(text)
    except ValueError:
        address = None
    if address is None or not address.is_loopback:
        raise AddressError(f"The emulator listens on loopback only; give an address 127.x.y.z, not {text[:60]}.")
    return str(address)
