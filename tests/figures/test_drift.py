"""The drift study in its short form: knocks and a creep are found in time, a quiet minute raises no alarm."""

from tests.figures.motion.drift import CREEP_M_S, creep_trial, knock_trial, watched
from tests.worlds.moves import WorldConfig


def test_the_short_form_meets_the_targets() -> None:
    knocks = [knock_trial(WorldConfig(), seed, turn=bool(seed)) for seed in (0, 1)]
    assert all(t.found_after_s <= 2.0 for t in knocks)
    creep = creep_trial(WorldConfig(), 5000)
    assert 1e3 * CREEP_M_S * creep.found_after_s < 0.2
    quiet, largest = watched(WorldConfig(), 36.0, 9000)
    assert not quiet.events
    assert not any(t.false_alarms for t in (*knocks, creep))
    assert largest < 0.8 * quiet.threshold


def test_a_trial_says_what_the_change_was() -> None:
    trial = knock_trial(WorldConfig(), 1, turn=True)
    assert trial.named == "rotation"
    assert trial.rotation_error_deg < 0.01
    assert abs(trial.time_error_s) < 0.3
