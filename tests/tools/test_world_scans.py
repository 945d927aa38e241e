"""The world's triggered scanner: on a slow computer the world waits for its scan, and not for a scanner that has
stopped."""

from __future__ import annotations

import pytest

from weldcal.tools.emulators.cell import scanner_process
from weldcal.tools.emulators.cell.scanner_process import DONE, FRAME_WAITS_S, POSE, SCAN_S, Scans


class Scanner:
    """The scanner's end of the pipe: what it says next, what it was told, and for how long (s) the world waited for
    it."""

    def __init__(self) -> None:
        self.says: list[str] = []
        self.told: list[object] = []
        self.waits: list[float] = []
        self.gone = False

    def poll(self, timeout: float) -> bool:
        if timeout > 0.0:
            self.waits.append(timeout)
        return self.gone or bool(self.says)

    def recv(self) -> str:
        if self.gone:
            raise EOFError
        return self.says.pop(0)

    def send(self, it: object) -> None:
        self.told.append(it)


def exposed(at_s: float) -> tuple[Scans, Scanner]:
    """A world whose scanner began a scan at this time (s)."""
    scanner = Scanner()
    it = Scans(scanner, lambda: ("now", "positions"))  # type: ignore[arg-type]
    it.step(at_s - 0.1)
    assert scanner.told == []
    scanner.says.append(POSE)
    it.step(at_s)
    return it, scanner


def test_the_scanner_is_told_how_the_world_stands_when_it_exposes() -> None:
    _, scanner = exposed(1.0)
    assert scanner.told == [("now", "positions")]


def test_the_world_waits_in_each_frame_once_a_scan_is_late_and_no_more_when_it_is_there() -> None:
    it, scanner = exposed(1.0)
    it.step(1.0 + 0.9 * SCAN_S)
    assert scanner.waits == []
    it.step(1.0 + 1.1 * SCAN_S)
    it.step(1.0 + 1.2 * SCAN_S)
    assert scanner.waits == [FRAME_WAITS_S, FRAME_WAITS_S]
    scanner.says.append(DONE)
    it.step(1.0 + 1.3 * SCAN_S)
    it.step(1.0 + 9.0 * SCAN_S)
    assert len(scanner.waits) == 2


def test_a_scanner_that_says_nothing_is_waited_for_up_to_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    it, scanner = exposed(0.0)
    monkeypatch.setattr(scanner_process, "LIMIT_S", -1.0)
    it.step(2.0 * SCAN_S)
    assert scanner.waits == []


def test_a_scanner_that_is_gone_does_not_end_the_world() -> None:
    it, scanner = exposed(0.0)
    scanner.gone = True
    it.step(2.0 * SCAN_S)
    assert scanner.told == [("now", "positions")]
