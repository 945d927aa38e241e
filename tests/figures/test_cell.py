"""The weld in the cell as a study: what it measures, and what it holds against what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.figures.cell.runs import STUDY, TARGETS, cases, targets
from tests.worlds.weld.case import CellRun, scatter
from weldcal.models.errors import WeldcalError
from weldcal.tools.farm.run import Farm

GOOD = vars(
    CellRun(
        scenario="s_groove",
        seed=0,
        completed=True,
        reason="",
        point_sd_mm=0.01,
        torch_mean_mm=0.05,
        torch_max_mm=0.2,
        real_time_factor=1.4,
    )
)


def test_scatter_is_the_noise_and_not_the_wave_under_it() -> None:
    noise = np.random.default_rng(0).normal(0.0, 1.0, 1200)
    wave = 30.0 * np.sin(np.linspace(0.0, 12.0, 1200))
    # 1200 values give a deviation to 2 %.
    assert scatter(noise + wave) == pytest.approx(1.0, rel=0.06)


@pytest.mark.parametrize(
    ("worse", "missed"),
    [
        ({}, []),
        ({"point_sd_mm": 0.03}, ["point_sd_mm"]),
        ({"torch_max_mm": 0.31, "torch_mean_mm": 0.2}, ["torch_mean_mm", "torch_max_mm"]),
        ({"real_time_factor": 0.5}, ["real_time_factor"]),
    ],
)
def test_one_bad_run_misses_its_target(worse: dict[str, float], missed: list[str]) -> None:
    reached = targets([GOOD, {**GOOD, "seed": 1, **worse}])
    assert list(reached) == [name for name, *_ in TARGETS]
    assert [name for name, target in reached.items() if not target.met] == missed


def test_runs_without_a_weld_miss_every_target() -> None:
    broken = CellRun(scenario="s_groove", seed=0, completed=False, reason="held")
    assert not any(target.met for target in targets([vars(broken)]).values())


def test_a_slow_computer_does_not_fail_the_study() -> None:
    assert STUDY.measured({"slow": {**GOOD, "real_time_factor": 0.1}}).met
    assert not STUDY.measured({"off": {**GOOD, "torch_max_mm": 0.4}}).met


@pytest.mark.parametrize("wrong", [{"scenarios": ("nowhere",)}])
def test_what_is_not_known_is_refused_before_any_work(wrong: dict[str, Any], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with pytest.raises(WeldcalError):
        STUDY.run(Farm(folder, 0), cases(**{"scenarios": ("s_groove",), "seeds": range(1), **wrong}))
    assert not folder.exists()


def test_the_table_has_every_run_and_grows_with_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "out"

    def weld_once(name: str, seed: int, seam_mm: float | None) -> dict[str, Any]:
        # the first line names the study
        assert len((folder / "tasks.jsonl").read_text().splitlines()) == 1 + seed
        return {**GOOD, "scenario": name, "seed": seed, "torch_max_mm": 0.1 * (seed + 1)}

    monkeypatch.setattr("tests.figures.cell.runs.weld_once", weld_once)
    study = STUDY.run(Farm(folder, 0), cases(("l_groove",), range(2)))
    assert study.met
    assert [run["seed"] for run in study.figures["runs"]] == [0, 1]
    table = json.loads((folder / "summary.json").read_text())
    assert table["targets"]["torch_max_mm"] == {"value": pytest.approx(0.2), "limit": 0.3, "met": True}
    assert (folder / "runs.csv").read_text().count("\nl_groove ") == 2
