"""The study of replay: each run is recorded and replayed, and the table says which replays are identical."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from weldcal.tools.commands.record import RECORDING
from weldcal.tools.farm.journal import Result
from weldcal.tools.farm.run import Farm
from weldcal.tools.studies.replay import study
from weldcal.tools.studies.replay.study import KINDS, Kind, run_replays

HELD = "job: {maximum_time_s: 1.0}\nscanner: {width: 412, height: 308}"


class Here(Farm):
    """Runs the tasks in this process."""

    def run(
        self,
        function: Callable[..., Mapping[str, object]],
        tasks: Mapping[str, Mapping[str, Any]],
        each: Callable[[dict[str, Result]], None] | None = None,
    ) -> dict[str, Result]:
        found = {name: dict(function(**given)) for name, given in tasks.items()}
        if each is not None:
            each(found)
        return found


def test_a_run_is_recorded_and_replayed_and_only_a_recording_that_differs_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study, "KINDS", {"held soon": Kind("calibrate_only", HELD)})
    summary, table = run_replays(Here(tmp_path), 1, 4)
    assert (summary["state"], summary["runs"], summary["identical"]) == ("done", 1, 1)
    row = summary["per_run"]["held soon, seed 4"]  # type: ignore[index]
    assert (row["run"], row["replayed"], row["first"]) == ("held", "identical", "")
    assert row["compared"] > 100
    assert "| held soon, seed 4 | held | identical | 1." in table
    assert (tmp_path / "replays.csv").read_text().count("\n") == 2
    assert not list(tmp_path.rglob(RECORDING))


def test_simulation_controller_wires_and_faults_are_all_among_the_kinds() -> None:
    kinds = KINDS.values()
    assert {kind.robot for kind in kinds} == {"simulated", "emulated", "wired"}
    assert {kind.fault for kind in kinds} == {"", "hole", "protective_stop", "finger", "scanner"}
    assert sum(kind.fault != "" or "hidden" in kind.overrides for kind in kinds) >= 5
