"""The drift study in its short form: knocks and a creep are found in time, a quiet minute raises no alarm."""

import json
from pathlib import Path

from typer.testing import CliRunner

from weldcal.tools.cli.app import app
from weldcal.tools.studies.motion.drift import knock_trial
from weldcal.tools.studies.motion.feature_world import WorldConfig


def test_the_short_form_meets_the_targets(tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["benchmark", "drift", "--quick", "--out", str(tmp_path), "--json"])
    assert found.exit_code == 0, found.output
    result = json.loads(found.stdout.strip().splitlines()[-1])
    assert result["found_within_2_s"] == result["knocks"] == 2
    assert result["false_alarms"] == 0
    assert result["largest_statistic"] < 0.8 * result["threshold"]
    assert max(result["creep_mm_when_found"]) < 0.2
    assert (tmp_path / "trials.csv").read_text().count("\n") == 4


def test_a_trial_says_what_the_change_was() -> None:
    trial = knock_trial(WorldConfig(), 1, turn=True)
    assert trial.named == "rotation"
    assert trial.rotation_error_deg < 0.01
    assert abs(trial.time_error_s) < 0.3
