"""A study's tasks: the same numbers on any workers, nothing lost by a kill, and a sentence where something is wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.places import ROOT
from tests.worlds.hand_eye import imperfect_cell, ratios
from weldcal.calibration.data.dataset import load_dataset
from weldcal.models.errors import InputError
from weldcal.tools.farm.run import NAME, Farm

TASKS: dict[str, Mapping[str, object]] = {f"cell {seed}": {"kind": "both", "seed": seed} for seed in range(2)}
STUDY = """
import sys
from pathlib import Path
from weldcal.tools.farm.run import Farm
from tests.worlds.hand_eye import ratios
if __name__ == "__main__":
    tasks = {f"cell {seed}": {"kind": "both", "seed": seed} for seed in range(400)}
    Farm(Path(sys.argv[1]), workers=1).run(ratios, tasks)
"""


def test_one_process_two_processes_and_a_dask_cluster_give_the_same_bits(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install 'weldcal[dask]'")
    shown: list[tuple[str, float]] = []
    two = Farm(tmp_path / "two", workers=2, progress=lambda what, share: shown.append((what, share))).run(ratios, TASKS)
    with distributed.LocalCluster(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as cluster:
        dask = Farm(tmp_path / "dask", scheduler=cluster.scheduler_address).run(ratios, TASKS)
    assert json.dumps(two) == json.dumps(dask)
    assert list(two) == list(TASKS)
    assert two["cell 0"] != two["cell 1"]
    assert [share for _, share in shown] == [0.5, 1.0]


def test_a_killed_study_goes_on_with_the_tasks_that_are_missing(tmp_path: Path) -> None:
    script = tmp_path / "study.py"
    script.write_text(STUDY)
    journal = tmp_path / "out" / NAME
    command, environment = [sys.executable, "-P", str(script), str(tmp_path / "out")], {"PYTHONPATH": str(ROOT)}
    study = subprocess.Popen(command, start_new_session=True, env=os.environ | environment)
    try:
        end = time.monotonic() + 120.0
        while not (journal.exists() and journal.read_bytes().count(b"\n") > 2):
            assert study.poll() is None
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        os.killpg(study.pid, signal.SIGKILL)
        study.wait()
    journal.write_bytes(journal.read_bytes() + b'{"task": "cell 399", "arg')
    kept = [json.loads(line) for line in journal.read_bytes().split(b"\n")[1:-1]]
    tasks = {entry["task"]: entry["arguments"] for entry in kept} | {"last": {"kind": "both", "seed": 1000}}
    shown: list[float] = []
    found = Farm(tmp_path / "out", workers=1, progress=lambda what, share: shown.append(share)).run(ratios, tasks)
    assert shown == [1.0]  # one task was missing
    assert {name: found[name] for name in list(tasks)[:-1]} == {entry["task"]: entry["result"] for entry in kept}
    assert len(journal.read_bytes().split(b"\n")) == len(kept) + 3


def test_a_task_that_cannot_be_done_does_not_end_the_study_and_is_done_again_with_other_arguments(
    tmp_path: Path,
) -> None:
    for name in ("none", "another"):
        found = Farm(tmp_path, workers=1).run(load_dataset, {"task": {"folder": str(tmp_path / name)}})
        assert found["task"]["state"] == "failed"
        assert f"'{tmp_path / name}'" in found["task"]["reason"]


def test_the_folder_of_another_study_is_refused(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text('{"function": "other:study"}\n')
    with pytest.raises(InputError, match="--out"):
        Farm(tmp_path).run(imperfect_cell, {})


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'weldcal[dask]'")
    monkeypatch.setattr("weldcal.tools.farm.pools.REACH_S", 0.5)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9"):
        Farm(tmp_path, scheduler="tcp://127.0.0.1:9").run(ratios, TASKS)
