"""The study of conventions counts sets that the data determine, and readings that are used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.data.poses.readings import readings
from weldcal.tools.cli.app import app
from weldcal.tools.worlds.hand_eye import written_set


@pytest.mark.parametrize("seed", range(8))
def test_the_stated_forms_read_the_written_poses(seed: int) -> None:
    """Without noise, the relative rotations of both lists under the stated forms have equal angles."""
    made = written_set(np.random.default_rng(seed))
    angles = []
    for numbers, form in ((made.robot, made.forms[0]), (made.exact, made.forms[1])):
        plain, _, _ = form.partition(",transposed" if "transposed" in form else ",left_handed")
        one = next(r for r in readings(numbers) if r.form == plain or plain.startswith(r.form))
        if form != plain:
            one = one.changed(form.rpartition(",")[2])
        turn = Rotation.from_matrix(one.X[:, :3, :3])
        angles.append(
            (turn[:-1].inv() * turn[1:]).magnitude()
            if numbers is made.robot
            else (turn[:-1] * turn[1:].inv()).magnitude()
        )
    assert angles[0] == pytest.approx(angles[1], abs=1e-6)


def test_the_command_counts_no_wrong_reading(tmp_path: Path) -> None:
    call = ["benchmark", "hand-eye-conventions", "--runs", "2", "--tails", "200", "--json", "--out", str(tmp_path)]
    found = CliRunner().invoke(app, call)
    assert found.exit_code == 0, found.output
    figures = json.loads(found.output.splitlines()[-1])
    assert (figures["sets"], figures["wrong"]) == (2, 0)
    assert [tail["compared"] for tail in figures["tails"]] == [200, 200, 200]
