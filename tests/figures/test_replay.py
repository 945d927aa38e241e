"""The study of replay: each run is recorded and replayed, and the table says which replays are identical."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.figures.cell import replays
from tests.figures.cell.replays import KINDS, REPLAYS, Kind, replay_cases
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.commands.run import RECORDING
from weldcal.tools.farm.run import Farm

HELD = "job: {maximum_time_s: 1.0}\nscanner: {width: 412, height: 308}"


def test_a_run_is_recorded_and_replayed_and_only_a_recording_that_differs_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replays, "KINDS", {"held soon": Kind("calibrate_only", HELD)})
    found = REPLAYS.run(Farm(tmp_path, workers=0), replay_cases(tmp_path, 1, 4))
    summary, table = found.figures, found.markdown()
    assert (summary["state"], summary["runs"], summary["identical"]) == ("done", 1, 1)
    row = summary["per_run"]["held soon, seed 4"]
    assert (row["run"], row["replayed"], row["first"]) == ("held", "identical", "")
    assert row["compared"] > 100
    assert "| held soon, seed 4 | held | identical | 1." in table
    assert (tmp_path / "runs.csv").read_text().count("\n") == 2
    assert not list(tmp_path.rglob(RECORDING))


def test_simulation_controller_wires_and_faults_are_all_among_the_kinds() -> None:
    kinds = KINDS.values()
    assert {kind.robot for kind in kinds} == {"simulated", "emulated", "wired"}
    assert {kind.fault for kind in kinds} == {"", "hole", "protective_stop", "finger", "scanner"}
    assert sum(kind.fault != "" or "hidden" in kind.overrides for kind in kinds) >= 5


def test_the_overhead_is_that_of_the_pairs_and_its_interval_holds_it() -> None:
    rng = np.random.default_rng(3)
    plain = rng.uniform(20.0, 40.0, 9)
    recorded = 1.03 * plain * np.exp(rng.normal(0.0, 0.01, 9))
    recorded[4] *= 1.3  # a host that was busy with something else
    found = replays.overhead(np.column_stack([plain, recorded]))
    assert found["low"] < 3.0 < found["high"]
    assert found["percent"] == pytest.approx(3.0, abs=1.5)
    assert found["high"] - found["low"] < 5.0


def test_the_interval_holds_the_true_overhead_in_nineteen_of_twenty_studies() -> None:
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(400):
        plain = np.exp(rng.normal(3.2, 0.05, 11))
        found = replays.overhead(np.column_stack([plain, 1.04 * np.exp(rng.normal(3.2, 0.05, 11))]))
        held += found["low"] <= 4.0 <= found["high"]
    assert held >= 370  # 380 expected, less three standard deviations


def test_the_runs_of_a_pair_work_in_turns_and_the_first_pair_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worked: list[tuple[int, int]] = []  # pair, side

    def seconds(folder: Path, seed: int, *, record: bool, progress: Progress) -> tuple[float, float, float]:
        assert seed == 4
        pair, side = int(folder.parent.name.removeprefix("pair_")), int(folder.name)
        assert record == (side == 1)
        for _ in range(20 if record else 30):
            worked.append((pair, side))
            progress("", 0.0)
        used = 99.0 if pair == 0 else 10.2 if record else 10.0
        return used, 117.0 if record else 0.0, 5.0

    monkeypatch.setattr(replays, "seconds", seconds)
    monkeypatch.setattr(replays, "get_context", lambda _: ThreadsInTurns)
    monkeypatch.setattr(replays, "ProcessPoolExecutor", ThreadsInTurns.pool)
    monkeypatch.setattr(replays, "_TURNS", [])
    summary, table = replays.run_overhead(tmp_path, 6, 4, no_progress)
    of_a_pair = [side for pair, side in worked if pair == 3]
    assert of_a_pair == 20 * [0, 1] + 10 * [0]
    assert summary["overhead"] == pytest.approx({"percent": 2.0, "low": 2.0, "high": 2.0})
    assert "| 1 | 10.00 | 10.20 | 117 |" in table
    assert "2.0 % of computing time" in table
    assert summary["percent_of_a_core"] == pytest.approx(4.0)


class ThreadsInTurns:
    """Threads in place of processes."""

    @staticmethod
    def Semaphore(value: int) -> TimedSemaphore:
        return TimedSemaphore(value)

    @staticmethod
    def pool(
        workers: int, *, mp_context: object, initializer: Callable[..., None], initargs: Iterable[Any]
    ) -> ThreadPoolExecutor:
        initializer(*initargs)
        return ThreadPoolExecutor(workers)


class TimedSemaphore(threading.Semaphore):
    """With the words of a semaphore of processes."""

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        return super().acquire(block, timeout)
