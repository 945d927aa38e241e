"""The tablet paper comes out of its own data: both chains, both stages, its wrong sign and its slip."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.figures.harness import Run
from tests.figures.tablet.evolution import cost, evolve
from tests.figures.tablet.reproduce import compare_models, reproduce_stages, tablet
from tests.places import SHARED_DATA, require_data
from tests.worlds.tablet import STAGE_1, STAGE_2, published_touches
from weldcal.calibration.errors import CollinearLandmarks, EqualRotations, TabletDataError, TooFewLandmarks
from weldcal.calibration.tablet.published import (
    AFFINE_NONE,
    AFFINE_RANGE,
    DH_NAMES,
    HTM_NAMES,
    Sign,
    StageResult,
    fitness,
    hand_to_touch,
    place_landmarks,
    search_range,
    stage1_residuals,
    stage2_residuals,
    tablet_stage1,
    tablet_stage2,
)
from weldcal.calibration.tablet.touches import TabletTouches

PUBLISHED = SHARED_DATA / "profiler/tablet_published.npz"
GATE_MM = 0.0015  # the issue's: half the last printed digit is 0.005


@pytest.fixture(scope="module")
def touches() -> TabletTouches:
    return published_touches()


@pytest.fixture(scope="module")
def found(touches: TabletTouches) -> dict[tuple[str, int], StageResult]:
    """The fast solver's stages of both chains."""
    return {(r.model, r.stage): r.ours for r in reproduce_stages(touches, ())}


def test_the_typed_tables_are_those_of_the_shared_file(touches: TabletTouches) -> None:
    require_data(PUBLISHED)
    d = np.load(PUBLISHED)
    for mine, theirs in (
        (touches.uv_px, d["uv"]),
        (1e3 * touches.depth_m, d["depth"]),
        (1e3 * touches.hand_m, d["hand"]),
        (touches.delta_px, d["delta_px"]),
        (touches.landmark_px, d["tablet_px"]),
        (np.degrees(touches.theta_rad), d["theta_deg"]),
        (1e3 * touches.pitch_m, d["mm_per_px"]),
        (STAGE_1["htm"].parameters, d["htm_published"]),
        (STAGE_1["dh"].parameters, d["dh_published"]),
        (STAGE_2["htm"].parameters, np.r_[d["affine1_htm"], d["affine2_htm"]]),
        (STAGE_2["dh"].parameters, np.r_[d["affine1_dh"], d["affine2_dh"]]),
    ):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)


def test_every_table_comes_out(found: dict[tuple[str, int], StageResult]) -> None:
    for stage, F in ((("htm", 1), 1.6739), (("htm", 2), 0.9989), (("dh", 1), 7.103), (("dh", 2), 4.272)):
        assert pytest.approx(F, abs=GATE_MM) == found[stage].fitness.F


def test_the_parameters_are_the_printed_ones(found: dict[tuple[str, int], StageResult]) -> None:
    seven = dict(zip(HTM_NAMES, found["htm", 1].parameters, strict=True))
    # the paper's inputs are printed rounded: re-rounded they move x_c and y_c by up to 0.1 mm, the others less
    for name, printed in zip(HTM_NAMES, STAGE_1["htm"].parameters, strict=True):
        mirrored = abs(seven[name]) if name in ("alpha_t", "beta_t") else seven[name]
        wanted = abs(printed) if name in ("alpha_t", "beta_t") else printed
        assert mirrored == pytest.approx(wanted, abs=0.11 if name in ("x_c", "y_c") else 0.035), name
    eight = dict(zip(DH_NAMES, found["dh", 1].parameters, strict=True))
    assert eight["theta1_c"] + eight["gamma_c"] == pytest.approx(-1.28, abs=0.02)
    assert eight["theta1_t"] + eight["gamma_t"] == pytest.approx(-5.90, abs=0.02)
    for name, printed in zip(DH_NAMES, STAGE_1["dh"].parameters, strict=True):
        if "theta1" not in name and name not in ("gamma_c", "gamma_t"):
            assert abs(eight[name]) == pytest.approx(abs(printed), abs=0.035), name
    for model in ("htm", "dh"):
        np.testing.assert_allclose(found[model, 2].parameters, STAGE_2[model].parameters, rtol=0, atol=0.02)


def test_the_figure_shows_each_table_and_a_picture(tmp_path: Path) -> None:
    run = Run(out=tmp_path)
    tablet(run)
    for number in (7, 8, 9, 10, 11, 12):
        assert f"Table {number}" in "".join(run.text)
    assert "<svg" in (tmp_path / "residuals.svg").read_text()


def test_left_out_landmarks_are_predicted_three_times_better(touches: TabletTouches) -> None:
    left_out = {m.name: m.left_out_mm for m in compare_models(touches)}
    assert left_out["paper, stage 1 + 2, sign as printed"] == pytest.approx(1.251, abs=0.005)
    assert left_out["closed form"] <= 0.46


def test_differential_evolution_ends_where_the_fast_solver_does(touches: TabletTouches) -> None:
    for r in reproduce_stages(touches, (1, 2, 3)):
        for evolved in r.evolved:
            assert pytest.approx(r.ours.fitness.F, abs=1e-5) == evolved.fitness.F
    again, same = (evolve(touches, "htm", 1, 3, 20, 3) for _ in range(2))
    assert (again.parameters == same.parameters).all()


def test_the_compiled_cost_is_that_of_the_residuals(touches: TabletTouches) -> None:
    rng = np.random.default_rng(0)
    for model in ("htm", "dh"):
        placed = place_landmarks(touches, STAGE_1[model].parameters, model)
        for stage, search in ((1, search_range(model)), (2, AFFINE_RANGE)):
            x = rng.uniform(search[:, 0], search[:, 1], (100, len(search)))
            r = (
                stage1_residuals(touches, x, model, Sign.PRINTED)
                if stage == 1
                else stage2_residuals(touches, x, placed, Sign.PRINTED)
            )
            wanted = [fitness(one).F for one in r]
            np.testing.assert_allclose(cost(touches, model, stage, x), wanted, rtol=1e-12)


def test_a_tilt_and_its_mirror_image_fit_alike(touches: TabletTouches) -> None:
    x = STAGE_1["htm"].parameters
    mirrored = x * np.where(np.isin(np.arange(12), (7, 8)), -1.0, 1.0)
    one, other = (stage1_residuals(touches, p, "htm", Sign.PRINTED) for p in (x, mirrored))
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_the_sign_reversed_the_papers_own_scheme_fits_twice_as_well(touches: TabletTouches) -> None:
    first = tablet_stage1(touches, sign=Sign.CORRECTED)
    second = tablet_stage2(touches, first.parameters, sign=Sign.CORRECTED)
    assert pytest.approx(1.2770, abs=GATE_MM) == first.fitness.F
    assert pytest.approx(0.5915, abs=GATE_MM) == second.fitness.F


def test_no_affine_pair_changes_nothing(touches: TabletTouches) -> None:
    stage1 = place_landmarks(touches, STAGE_1["htm"].parameters, "htm")
    plain = stage1_residuals(touches, STAGE_1["htm"].parameters, "htm", Sign.PRINTED)
    np.testing.assert_allclose(stage2_residuals(touches, AFFINE_NONE, stage1, Sign.PRINTED), plain, atol=1e-12)


def test_the_hand_asked_for_is_the_one_that_f2_measures(touches: TabletTouches) -> None:
    x, a = STAGE_1["htm"].parameters, STAGE_2["htm"].parameters
    placed = place_landmarks(touches, x, "htm")
    asked = hand_to_touch(touches, x, a, touches.uv_px, touches.depth_m, touches.theta_rad)
    target = touches.hand_m - 1e-3 * placed.correction[0]
    f2 = fitness(stage2_residuals(touches, a, placed, Sign.PRINTED)).f2
    assert 1e3 * np.linalg.norm(asked - target, axis=1).mean() == pytest.approx(f2, abs=1e-9)


def test_every_search_range_holds_the_printed_parameters() -> None:
    for model in ("htm", "dh"):
        low, high = search_range(model).T
        assert ((low <= STAGE_1[model].parameters) & (STAGE_1[model].parameters <= high)).all()


def test_touches_that_fix_nothing_are_named(touches: TabletTouches) -> None:
    with pytest.raises(TooFewLandmarks, match="3 landmarks are too few"):
        tablet_stage1(touches.pick(np.arange(3)))
    with pytest.raises(CollinearLandmarks, match="one line"):
        tablet_stage1(replace(touches, landmark_px=np.c_[100.0 * np.arange(9), 50.0 * np.arange(9)]))
    with pytest.raises(EqualRotations, match="turn the last joint"):
        tablet_stage1(replace(touches, theta_rad=np.full(9, 0.4)))
    with pytest.raises(TabletDataError, match="finite"):
        replace(touches, hand_m=np.full((9, 2), np.nan))
    with pytest.raises(TabletDataError, match="shape"):
        replace(touches, depth_m=np.ones(8))
