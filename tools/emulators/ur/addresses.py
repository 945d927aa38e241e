"""Loopback addresses of emulated controllers: one owner at a time, by a file lock, and free ports."""

import fcntl
import os
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from weldcal.models.errors import InputError

PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT, RTDE_PORT, DASHBOARD_PORT = 30001, 30002, 30003, 30004, 29999
PORTS = (DASHBOARD_PORT, PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT, RTDE_PORT)
DEFAULT = "127.0.0.1"
OWN = "127.29.{}.{}"  # where an emulator without an address looks for one
TRIED = 64


@contextmanager
def take_address(host: str, limit_s: float) -> Iterator[str]:
    """The address, for this process alone; waits for another owner.

    Raises:
        InputError: another process holds it for limit_s.
    """
    with lock_path(host).open("w") as handle:
        until = time.monotonic() + limit_s
        while not _locked(handle):
            if time.monotonic() > until:
                raise InputError(
                    f"Another emulated controller has held the ports of {host} for {limit_s:.0f} s; "
                    "wait for it, stop it, or use another loopback address."
                )
            time.sleep(0.05)
        yield host


@contextmanager
def free_address(ports: Sequence[int]) -> Iterator[str]:
    """The first loopback address that has no owner and on which all these ports are free.

    Raises:
        InputError: a port is taken on every address.
    """
    taken = 0
    for k in range(TRIED):
        host = OWN.format(k // 250, 1 + k % 250)
        with lock_path(host).open("w") as handle:
            if not _locked(handle):
                continue
            taken = first_taken(host, ports)
            if taken:
                continue
            yield host
            return
    raise InputError(
        f"Port {taken} is taken on every loopback address; stop the program that listens on all addresses (0.0.0.0)."
    )


def first_taken(host: str, ports: Sequence[int]) -> int:
    """The first of these ports on which something listens at this address; 0 where all are free."""
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                return port
    return 0


def lock_path(host: str) -> Path:
    """The file whose lock keeps the ports of one address for one owner."""
    name = f"weldcal-ur-emulator-{os.getuid()}" + ("" if host == DEFAULT else f"-{host}")
    return Path(tempfile.gettempdir()) / f"{name}.lock"


def _locked(handle: IO[str]) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
