"""The whole-body study in a short form: a wrist link is tracked by its mesh and by a fused model, no worse than twice
the flange."""

import json
from pathlib import Path

import pytest

from tests.figures.motion.throughput import run_whole_body
from tests.worlds.motion import MotionOptions
from weldcal.models.errors import InputError


def test_a_wrist_link_is_tracked_as_well_as_the_flange(tmp_path: Path) -> None:
    options = MotionOptions(
        robot="ur10e", size=(400, 300), frames=12, noise_mm=0.25, exposure_samples=2, surroundings=False, seed=1
    )
    found, targets = run_whole_body(tmp_path, options)
    assert found["state"] == "done"
    assert all(t.met for t in targets)
    for name in ("mesh", "fused"):
        row = found[name]
        assert isinstance(row, dict)
        assert row["frames"] + row["dropped"] == 12
        assert row["dropped"] <= 1
        assert row["rms_mm"] < 0.3
        assert row["spread_mm"] < 0.1
    assert json.loads((tmp_path / "result.json").read_text())["mesh"] == found["mesh"]


def test_a_link_that_the_arm_does_not_have_is_named_before_anything_is_rendered(tmp_path: Path) -> None:
    told: list[str] = []
    with pytest.raises(InputError, match="has no link 'elbow': use one of shoulder_link"):
        run_whole_body(tmp_path, MotionOptions(frames=12), "elbow", lambda stage, share: told.append(stage))
    assert told == []
