"""The weld in the cell as a study: what it measures, and what it holds against what."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import WeldcalError
from weldcal.tools.studies.cell.study import TARGETS, CellStudy, CellStudyOptions, hold_against, run_cell_study
from weldcal.tools.worlds.weld.cell_run import CellRun, scatter

GOOD = CellRun(
    scenario="s_groove",
    law="guarded",
    seed=0,
    completed=True,
    reason="",
    point_sd_mm=0.01,
    torch_mean_mm=0.05,
    torch_max_mm=0.2,
    real_time_factor=1.4,
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
    reached = hold_against([GOOD, CellRun(**{**vars(GOOD), "seed": 1, **worse})])
    assert [name for name, *_ in reached] == [name for name, *_ in TARGETS]
    assert [name for name, _, _, ok in reached if not ok] == missed


def test_runs_without_a_weld_miss_every_target() -> None:
    assert not any(
        ok
        for *_, ok in hold_against(
            [CellRun(scenario="s_groove", law="guarded", seed=0, completed=False, reason="held")]
        )
    )


def test_a_slow_computer_does_not_fail_the_study() -> None:
    cell = CellStudy(CellStudyOptions(Path("out")), (), 1.0, (("real_time_factor", 0.1, 1.0, False),))
    assert cell.met
    assert not replace(cell, reached=(("torch_max_mm", 0.4, 0.3, False),)).met


@pytest.mark.parametrize("wrong", [{"scenarios": ("nowhere",)}, {"law": "magic"}])
def test_what_is_not_known_is_refused_before_any_work(wrong: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(WeldcalError):
        run_cell_study(CellStudyOptions(tmp_path / "out", **wrong))  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_the_table_has_every_run_and_grows_with_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def weld(name: str, seed: int, *_: object) -> CellRun:
        written = tmp_path / "out" / "table.json"
        assert len(json.loads(written.read_text())["runs"]) == seed if written.exists() else seed == 0
        return CellRun(**{**vars(GOOD), "scenario": name, "seed": seed, "torch_max_mm": 0.1 * (seed + 1)})

    monkeypatch.setattr("weldcal.tools.studies.cell.study.weld_once", weld)
    study = run_cell_study(CellStudyOptions(tmp_path / "out", ("l_groove",), 2))
    assert study.met
    assert [r.seed for r in study.runs] == [0, 1]
    table = json.loads((tmp_path / "out" / "table.json").read_text())
    assert table["targets"]["torch_max_mm"] == {"value": pytest.approx(0.2), "limit": 0.3, "met": True}
    assert (tmp_path / "out" / "runs.csv").read_text().count("l_groove") == 2
