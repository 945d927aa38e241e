"""z of the profiles may grow away from the sensor or towards it: the profiles say which, or the command asks."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.profiler.height_sets import _called, counted, profile_set, record_text, tried, write_folder
from weldcal.calibration.errors import FeatureNotFound, InconsistentData, TooFewTranslations
from weldcal.calibration.profiler.depth_sign import SignFit, choose_sign
from weldcal.calibration.profiler.importing import import_profiles


def fit(shown: int, kept: int, variance: float = 1.0) -> SignFit:
    return SignFit(shown=shown, kept=kept, variance=variance, freedom=2 * shown - 10)


def never() -> bool:
    return False


def test_a_small_set_of_every_part_and_sign_has_no_wrong_one() -> None:
    counts = counted(10, 3)
    assert counts["wrong"] == 0
    assert counts["right"] + counts["wide"] >= 8
    assert counts["groove heights right"] == counts["groove depths  right"] == 1


@pytest.mark.parametrize(
    ("away", "towards", "chosen"),
    [
        (fit(24, 24), fit(3, 0), "away"),
        (fit(3, 0), fit(24, 24), "towards"),
        (fit(24, 23), fit(24, 24, 40.0), "away"),  # more agree, but far worse
        (fit(20, 10, 30.0), fit(20, 20), "towards"),
        (fit(24, 24), fit(11, 11, 0.5), "away"),
    ],
)
def test_the_sign_that_explains_more_profiles_is_taken(away: SignFit, towards: SignFit, chosen: str) -> None:
    grows, said = choose_sign({"away": away, "towards": towards}, 26, "bar", never)
    assert grows == chosen
    assert said.startswith(f"z of the profiles grows {chosen}")


def test_the_level_of_the_residuals_is_that_of_f() -> None:
    """F(30, 30) exceeds 3.69 with 3e-4 and 4.23 with 1e-4."""
    assert choose_sign({"away": fit(20, 20), "towards": fit(20, 20, 4.3)}, 20, "bar", never)[0] == "away"
    with pytest.raises(InconsistentData):
        choose_sign({"away": fit(20, 20), "towards": fit(20, 20, 3.6)}, 20, "bar", never)
    # fewer profiles need more: F(30, 28) exceeds 7.0 with 1e-6
    with pytest.raises(InconsistentData):
        choose_sign({"away": fit(20, 20, 4.8), "towards": fit(19, 19)}, 20, "bar", never)
    assert choose_sign({"away": fit(20, 20, 9.0), "towards": fit(19, 19)}, 20, "bar", never)[0] == "towards"


def test_signs_that_explain_alike_are_asked_for_or_agree() -> None:
    both = {"away": fit(20, 20), "towards": fit(20, 20, 0.8)}
    with pytest.raises(InconsistentData, match="--as z=away or --as z=towards"):
        choose_sign(both, 20, "bar", never)
    assert choose_sign(both, 20, "bar", lambda: True)[0] == "towards"
    assert choose_sign({"away": both["away"]}, 20, "bar", never)[0] == "away"


def test_few_profiles_with_an_edge_do_not_beat_many_without() -> None:
    with pytest.raises(InconsistentData):
        choose_sign({"away": fit(8, 8), "towards": fit(24, 0)}, 24, "step", never)


def test_refusals_count_the_profiles() -> None:
    few = SignFit(shown=3, error=TooFewTranslations("3 poses of the edge are too few: take more."))
    with pytest.raises(TooFewTranslations, match=r"3 of 26 profiles show the apex.*0 of 26"):
        choose_sign({"away": few, "towards": fit(0, 0)}, 26, "apex", never)
    with pytest.raises(FeatureNotFound, match="No profile shows the apex"):
        choose_sign({"away": fit(0, 0), "towards": fit(0, 0)}, 26, "apex", never)


def test_a_stated_sign_is_used(tmp_path: Path) -> None:
    made = profile_set(np.random.default_rng(8), "ridge", True, views=10)
    assert tried(made, tmp_path / "right", "--as", "z=towards")[0] in ("right", "wide")
    files = write_folder(made, tmp_path / "p")
    found, said = _called("edge", files, "--feature", "apex", "--as", "z=away", "--out", tmp_path / "o")
    assert not found
    assert "None of the 10 profiles shows the feature apex" in said
    assert "with z away from the sensor." in said
    assert (
        "z is away or towards, not 'up'"
        in _called("edge", files, "--feature", "apex", "--as", "z=up", "--out", tmp_path / "o")[1]
    )


@pytest.mark.parametrize("heights", [False, True])
def test_a_step_with_the_wrong_side_is_asked_about(heights: bool, tmp_path: Path) -> None:
    made = profile_set(np.random.default_rng([5, int(heights)]), "step", heights, views=20)
    other = {"left": "right", "right": "left"}[made.side]
    verdict, said = tried(replace(made, side=other), tmp_path / "wrong")
    sign = "towards" if heights else "away"
    assert verdict == "refused"
    assert f"--as side={made.side} --as z={sign}" in said
    assert tried(made, tmp_path / "right", "--as", f"z={sign}")[0] in ("right", "wide")


def test_a_seam_of_the_other_sign_than_its_calibration_is_refused(tmp_path: Path) -> None:
    made = profile_set(np.random.default_rng(2), "groove", True, views=12)
    files = write_folder(made, tmp_path / "p")
    X = made.X_FS.copy()
    X[:3, 3] *= 1e-3
    (tmp_path / "c").mkdir()
    for own, refused in (("away from the sensor", True), ("towards the sensor", False)):
        text = record_text(X).replace("figures: {}", f"figures: {{z_grows: {own}}}")
        (tmp_path / "c" / "profiler.yaml").write_text(text)
        found, said = _called("seam", files, "--calibration", tmp_path / "c", "--out", tmp_path / "o", "--overwrite")
        assert (not found) == refused, said
        assert ("X_FS holds for one of both" in said) == refused


def test_feature_points_of_yaml_profiles_are_read(tmp_path: Path) -> None:
    made = profile_set(np.random.default_rng(5), "ridge", True, views=8)
    folder = write_folder(made, tmp_path / "p")
    for k, p in enumerate(made.profiles):
        (folder / f"p{k + 1:02d}.txt").unlink()
        rows = ", ".join(f"{x:.3f}, 0., {z:.3f}" for x, z in p if np.isfinite([x, z]).all())
        (folder / f"p{k + 1:02d}.yml").write_text(
            f"%YAML:1.0\n---\nprofile: [ {rows} ]\nfeature_point: [ {k + 0.5}, 0., -2.25 ]\n"
        )
    found = import_profiles(folder)
    assert found.found is not None
    assert found.found == pytest.approx(1e-3 * np.array([[k + 0.5, -2.25] for k in range(8)]))
    assert re.search("yml|document", str(found.reading["profiles"]["form"]))
