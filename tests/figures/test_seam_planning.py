"""The figure of seam planning in its short form: one scanner and one shape."""

from tests.figures.parts.planning import plan_rows, plans_of


def test_a_coarse_scanner_is_refused_or_states_its_error() -> None:
    trials = plans_of(["azure_kinect"], 1, 50, lambda *_: None, ("s",))
    assert set(plan_rows(trials, "preset")) == {"azure_kinect cad", "azure_kinect cloud"}
    for trial in trials:
        # Noise of 1 mm and points 1.8 mm apart: refused in a sentence, or a line with a sigma that covers its error.
        assert trial["refused"] or trial["rms_mm"] < 3.0 * trial["sigma_mm"] < 2.0
