"""The conventions of two lists of poses are read as they were written, or left open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.written_sets import WrittenSet, written_set
from weldcal.calibration.data.poses.readings import readings
from weldcal.calibration.hand_eye.pairs.conventions import ReadingDecision, decide


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


NEAR_SIGMAS = 8.0  # of X: a reading that is written otherwise and gives the same result


def near(found: ReadingDecision, case: WrittenSet) -> bool:
    """Return whether X is within the errors that the noise causes."""
    n, best = len(case.robot.p), found.best
    turn = Rotation.from_matrix(best.X[:3, :3].T @ case.X[:3, :3]).magnitude()
    shift = float(np.linalg.norm(best.X[:3, 3] / case.scale - case.X[:3, 3]))
    spread = max(best.turn, 1e-3)
    sigma = case.rotation / np.sqrt(n) / min(spread, 1.0)
    moved = (case.position / case.scale + case.rotation) / np.sqrt(n) / min(spread, 1.0)
    return bool(turn < NEAR_SIGMAS * sigma + 1e-4 and shift < NEAR_SIGMAS * moved + 1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_no_wrong_reading_is_used(seed: int) -> None:
    case = written_set(np.random.default_rng(seed))
    found = decide(readings(case.robot), readings(case.camera), eye_in_hand=True)
    best = found.best
    if found.determined and best.agrees:
        assert (best.robot.form, best.camera.form) == case.forms or near(found, case)
        assert best.unit_scale == pytest.approx(case.unit_ratio, rel=0.01)
