"""Strangers at the ports of a run take nothing from it: neither descriptors, nor threads, nor the answer to Hold."""

from __future__ import annotations

import os
import socket
import statistics
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

import pytest
from pydrake.geometry import Meshcat, MeshcatParams

from tests.strangers import Address, connect, hold_ms, key_of, status, strangers
from weldcal.systems.operator import Operator
from weldcal.systems.viewer.live import LiveView
from weldcal.tools.connections import CONNECTIONS, VIEWS, guard
from weldcal.tools.dashboard.server import Dashboard
from weldcal.tools.dashboard.source import DashboardSource

HOLD_MS = 100.0
MANY = 400


@pytest.fixture
def source() -> DashboardSource:
    return DashboardSource(LiveView(), Operator())


@pytest.fixture
def page(source: DashboardSource) -> Iterator[Dashboard]:
    dashboard = Dashboard(source, "http://localhost:1", share=True)
    yield dashboard
    dashboard.close()


def address_of(url: str | None) -> tuple[Address, str]:
    """Where a page is reached from this computer, and its path."""
    assert url is not None
    _, _, host, path = url.split("/", 3)
    return ("127.0.0.1", int(host.split(":")[1])), "/" + path


def hold(address: Address, key: str) -> float:
    """The median time of Hold, ms."""
    return statistics.median(hold_ms(address, key) for _ in range(7))


@pytest.mark.parametrize("shared", [False, True], ids=["local", "shared"])
def test_strangers_take_neither_hold_nor_descriptors(page: Dashboard, source: DashboardSource, shared: bool) -> None:
    local, _ = address_of(page.url)
    attacked, path = address_of(page.shared_url if shared else page.url)
    key = key_of(local)
    descriptors, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    with strangers(attacked, MANY, 30, f"{path}events") as connections:
        assert len(connections) > MANY
        own = len(os.listdir("/proc/self/fd")) - len(connections)
        assert own <= descriptors + 2, "the pages' processes have them"
        assert threading.active_count() <= threads
        assert hold(local, key) < HOLD_MS
        assert source.operator.holds
        assert status(attacked, f"{path}values") == 200, "nobody is kept away by idle connections"
        assert status(attacked, f"{path}events", Origin="http://elsewhere.example") == 403


def test_a_page_has_a_limited_number_of_connections(page: Dashboard) -> None:
    address, _ = address_of(page.url)
    assert status(address, "/values") == 200
    with strangers(address, 3 * CONNECTIONS) as connections:
        time.sleep(0.5)
        assert len(connections) == 3 * CONNECTIONS
        assert sum(not ended(c) for c in connections) <= CONNECTIONS
        assert not ended(connections[-1]), "the oldest are ended"


def test_the_3d_view_has_a_limited_number_of_connections() -> None:
    view = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))
    guard(view)
    with strangers(("127.0.0.1", view.port()), MANY) as connections:
        time.sleep(0.5)
        assert sum(not ended(c) for c in connections) <= VIEWS
        spare = connect(("127.0.0.1", view.port()))
        assert spare is not None
        with spare:
            spare.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert spare.recv(15).startswith(b"HTTP/1.1 200")


def test_a_page_for_the_network_cannot_act_whatever_it_asks(page: Dashboard, source: DashboardSource) -> None:
    """The run itself refuses: the process of the shared page may be in strangers' hands."""
    ours, theirs = socket.socketpair()
    thread = threading.Thread(target=page._answer, args=(Connection(ours.detach()), False), daemon=True)
    thread.start()
    with Connection(theirs.detach()) as pipe:
        pipe.send(("act", "hold", None))
        assert pipe.recv() is False
    thread.join(5.0)
    assert not source.operator.holds


def test_values_that_cannot_be_shown_do_not_take_hold_away(page: Dashboard, source: DashboardSource) -> None:
    address, _ = address_of(page.url)
    key = key_of(address)
    source.facts = None  # type: ignore[assignment]
    assert status(address, "/values") == 200
    assert hold_ms(address, key) < float("inf")
    assert source.operator.holds


def ended(connection: socket.socket) -> bool:
    """Whether the other side has ended a connection."""
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
