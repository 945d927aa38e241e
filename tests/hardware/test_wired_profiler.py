"""A laser profiler by wire: its pose on the flange, found by the straightedge, against the truth that stays in the world."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.tools.commands.profiler.live import run_profiler_live
from weldcal.tools.emulators.cell.process import played_world
from weldcal.tools.outcomes.options import RunOptions

SEED = 3
FEW = "profiler_job: {edge: {scans: 12, held_out: 2}}"


def test_the_profilers_pose_is_that_of_the_truth_file(tmp_path: Path) -> None:
    host = f"127.35.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    text = (SCENARIO_FOLDER / "wired_profiler_edge.yaml").read_text(encoding="utf-8")
    text = text.replace("127.30.0.1", host).replace("/tmp/weldcal-cell/profiles", str(tmp_path / "profiles"))
    cell = tmp_path / "cell.yaml"
    cell.write_text(text, encoding="utf-8")
    world = (SCENARIO_FOLDER / "profiler_edge.yaml").read_text(encoding="utf-8")
    with played_world(tmp_path / "world", world, text, SEED) as played:
        scenario = load_scenario(str(cell), FEW)
        options = RunOptions("a test's own", tmp_path / "run", SEED, recording=False)
        live = run_profiler_live(scenario, options, lambda stage, share: None)
        truth = played.truth()
        with pytest.raises(InputError, match="stages: \\[edge\\]"):
            build_cell(load_scenario(str(cell), "profiler_job: {stages: [edge, sphere]}"))
    assert not live.run.held, live.run.reason
    assert live.run.cell.station.world is None
    assert live.state.edge is not None
    e = live.state.edge.estimate
    error = np.linalg.norm(e.translation - RigidTransform(np.array(truth["X_FS"])).translation())
    sigma = float(np.sqrt(np.trace(e.covariance[3:, 3:])))
    assert error < 3.5 * sigma
    assert 1e3 * sigma < 1.0
    edge = live.summary()["edge"]
    assert isinstance(edge, dict)
    assert "error_mm" not in edge, "the cell does not know the truth"
    assert (tmp_path / "run" / "report.html").exists()
