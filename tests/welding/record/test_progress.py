"""The progress of a weld is read as it was written, or refused with a sentence."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.welding.record.progress import CRATERS_NAME, PROGRESS_NAME, Progress, ProgressError, Stretch, load_progress
from weldcal.welding.record.weld_log import WeldRecord

BEGUN = Progress(scenario="mine", seed=3, robot=None, scenario_sha256="abc", ends=("killed", ""))


LINES: tuple[tuple[float, dict[str, object]], ...] = (
    (0.119, {}),
    (0.124, {}),
    (0.125, {}),
    (0.15, {"seam": 2}),
    (0.16, {"run": 0}),
)


def stretch(to_m: float, **more: object) -> Stretch:
    return replace(
        Stretch(seam=1, piece=0, run=1, from_m=0.092, to_m=to_m, done=False, time="2026-11-27T10:00:00+00:00"),
        **more,  # type: ignore[arg-type]
    )


def test_the_progress_comes_back_from_its_file(tmp_path: Path) -> None:
    felt = np.array([[0.1, 0.2, 0.3, 1e-4], [0.101, 0.2, 0.3, 2e-4]])
    made = replace(
        BEGUN.with_stretch(stretch(0.12)), seam=1, p_BCrater=np.array([0.1, 0.2, 0.3]), felt=felt, sigma_m=2e-4
    )
    made.write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [PROGRESS_NAME]
    found = load_progress(tmp_path)
    assert (found.scenario, found.seed, found.robot, found.ends) == ("mine", 3, None, ("killed", ""))
    assert found.stretches == made.stretches
    assert found.felt == pytest.approx(felt, abs=1e-9)
    assert found.X_BP is None
    restart = found.restart(6e-3)
    assert (restart.seam, restart.overlap_m) == (1, 6e-3)
    assert restart.sigma_m == pytest.approx(2e-4)


def test_the_crater_record_is_newer_than_the_progress(tmp_path: Path) -> None:
    made = replace(BEGUN.with_stretch(stretch(0.12)), seam=1, p_BCrater=np.array([0.1, 0.2, 0.3]))
    made.write(tmp_path)
    lines = [stretch(to_m, **more).line(np.array([to_m, 0.2, 0.3])) for to_m, more in LINES]

    def crater(*parts: str) -> float:
        (tmp_path / CRATERS_NAME).write_text("".join(parts))
        found = load_progress(tmp_path)
        assert found.p_BCrater is not None
        assert found.stretches[-1].to_m == pytest.approx(max(0.12, float(found.p_BCrater[0])))
        return float(found.p_BCrater[0])

    old, new, newer, other_seam, earlier_run = lines
    assert crater(old) == 0.1
    assert crater(old, new, newer) == 0.125
    assert crater(old, new, newer[:-1]) == 0.124, "a line that was not written to its end"
    assert crater(old, new, "\0\0\n") == 0.124
    assert crater(new, other_seam, earlier_run) == 0.124
    replace(made, seam=2, p_BCrater=np.array([0.1, 0.2, 0.3])).write(tmp_path)
    assert crater(new, newer) == 0.1, "that seam is finished"


def test_a_stretch_grows_until_its_seam_ends() -> None:
    grown = BEGUN.with_stretch(stretch(0.12)).with_stretch(stretch(0.13))
    assert [one.to_m for one in grown.stretches] == [0.13]
    ended = grown.with_stretch(stretch(0.2, done=True)).with_stretch(stretch(0.01, seam=2, from_m=0.0))
    assert [(one.seam, one.to_m, one.done) for one in ended.stretches] == [(1, 0.2, True), (2, 0.01, False)]


@pytest.mark.parametrize("change", [{"schema": "other"}, {"version": 1}, {"felt": [[1.0]]}, {"seed": "x"}])
def test_a_damaged_progress_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    BEGUN.write(tmp_path)
    path = tmp_path / PROGRESS_NAME
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ProgressError):
        load_progress(tmp_path)
    with pytest.raises(ProgressError, match="holds no broken weld"):
        load_progress(tmp_path / "nothing")
    assert math.isnan(BEGUN.sigma_m)


def log_of(times: list[float], phases: str, plans: list[int]) -> WeldRecord:
    return WeldRecord({"time_s": np.array(times)}, np.array(phases.split()), settings={"plans": plans})


def test_logs_of_two_runs_are_one_log() -> None:
    first = log_of([0.0, 0.008, 0.016, 0.024], "TOUCH TRACK TRACK TOUCH", [0, 1])
    both = log_of([5.0, 5.008], "TOUCH TRACK", [1]).after(first)
    assert both.phase.tolist() == ["TOUCH", "TRACK", "TRACK", "TOUCH", "TRACK"]
    assert both.settings["plans"] == [0, 1]
    assert both["time_s"] == pytest.approx([0.0, 0.008, 0.016, 1.016, 1.024])
