"""The whole-body figure in a short form: a wrist link is tracked by its mesh and by a fused model, no worse than twice
the flange."""

import numpy as np
import pytest

from tests.figures.motion.throughput import LINK, body_row, link_errors, scan_over_robot, track_body
from tests.worlds.motion import MotionOptions
from weldcal.calibration.data.motion_dataset import MotionDataset
from weldcal.calibration.data.results import CalibrationResult
from weldcal.calibration.motion.drift.watch import DriftHistory
from weldcal.models.errors import InputError


def test_a_wrist_link_is_tracked_as_well_as_the_flange() -> None:
    options = MotionOptions(
        robot="ur10e", size=(400, 300), frames=12, noise_mm=0.25, exposure_samples=2, surroundings=False, seed=1
    )
    drawn = {}

    def draw(data: MotionDataset, result: CalibrationResult, tracked: DriftHistory) -> None:
        drawn["errors"] = link_errors(data, result, tracked, LINK)
        drawn["scan"] = scan_over_robot(data, result, tracked)

    found = {name: body_row(w) for name, w in track_body(options, LINK, lambda *_: None, draw).items()}
    for name in ("mesh", "fused"):
        row = found[name]
        assert row["frames"] + row["dropped"] == 12
        assert row["dropped"] <= 1
        assert row["rms_mm"] < min(0.3, 2.0 * found["flange"]["rms_mm"])
        assert row["spread_mm"] < 0.1
    # Fig. 7: some 0.2 m/s at 140 ms, and what tracking leaves; Fig. 8: at the capture the scan lies on the robot
    _, before, after = drawn["errors"]
    assert np.linalg.norm(before[:, 3:], axis=1).max() > 10.0
    assert np.linalg.norm(after[:, 3:], axis=1).max() < 0.5
    rows = drawn["scan"].rows
    assert rows["robot"]["points"] > 5000
    assert abs(rows["wrist_1_link"]["signed_mm"]) < 0.1
    assert rows["wrist_1_link"]["median_mm"] < 0.5


def test_a_link_that_the_arm_does_not_have_is_named_before_anything_is_rendered() -> None:
    told: list[str] = []
    with pytest.raises(InputError, match="has no link 'elbow': use one of shoulder_link"):
        track_body(MotionOptions(frames=12), "elbow", lambda stage, share: told.append(stage))
    assert told == []
