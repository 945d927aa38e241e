"""The study of whole jobs on a controller ends where an operator ends one of its jobs."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.figures.robot import stream


def test_a_person_who_stops_a_job_stops_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []

    def stop() -> None:
        raise KeyboardInterrupt("The operator stopped the run with Ctrl-C, in the phase 'weld'.")

    def stopped(scenario: object, options: object) -> object:
        begun.append(1)
        return SimpleNamespace(run=SimpleNamespace(raise_if_interrupted=stop))

    @contextmanager
    def controller(**_: object) -> object:
        yield SimpleNamespace(host="127.0.0.1")

    @contextmanager
    def host() -> object:
        yield None

    monkeypatch.setattr(stream, "run_scenario", stopped)
    monkeypatch.setattr(stream, "emulator_process", controller)
    monkeypatch.setattr(stream, "watched_host", host)
    with pytest.raises(KeyboardInterrupt, match="in the phase 'weld'"):
        stream.run_jobs("s_groove", tmp_path, 3)
    assert begun == [1]
