"""A knock, a creep and a warm-up of the scanner are found and told apart; a quiet cell raises no alarm."""

from dataclasses import replace

import numpy as np
import pytest

from tests.worlds.moves import Change, FeatureWorld, WorldConfig, simulate
from weldcal.calibration.motion.drift.hypotheses import STEP, DriftFilter, FieldConfig, FilterConfig, PoseField
from weldcal.calibration.motion.drift.residuals import CLOCK, SIZE, FrameNoise, Rows, measured_noise
from weldcal.calibration.motion.drift.sequential import CREEP, MOVED, WARM_UP, DriftConfig, DriftTest

KNOCK_S = 22.3


def watched(world: FeatureWorld, rows: Rows | None = None, config: DriftConfig | None = None) -> DriftTest:
    """The test after all frames of a world, in parts of ten."""
    test = DriftTest(world.X_BC, world.covariance, world.pivot, config)
    rows = world.rows if rows is None else rows
    for k in range(0, len(rows), 10):
        test.update(rows.part(slice(k, k + 10)))
    test.finish()
    return test


def test_hypotheses_equal_one_regression_over_all_frames() -> None:
    """The bank's estimate and gain of a step are those of a dense regression on error, field and step together."""
    rows = simulate(WorldConfig(outliers=0.0), 3.0, 4).rows
    config = FilterConfig(
        wander_m=0.0, wander_rad=0.0, wander_clock_s=0.0, wander_scale=0.0, field=FieldConfig(largest=9)
    )
    cov, noise = np.diag([1e-8] * 3 + [1e-8] * 3), FrameNoise(4.0, 4.0, 1e-3)
    at = 25
    f, field = DriftFilter(cov, config), PoseField(config.field)
    prior = np.repeat([config.field.sigma_m, config.field.sigma_rad], [3, 2]) ** 2
    G, S, reached = [], [], []
    for i in range(len(rows)):
        if i == at:
            f.spawn(float(rows.times[i]), (STEP,))
        f.update(rows, i, noise, spawn=False)
        phi, left = field.features(rows.centers[i], rows.normals[i])
        if left > config.field.novelty:
            continue
        reached.append(i)
        row = np.zeros((5, 2 * SIZE + 5 * 9))
        row[:, :SIZE] = rows.derivatives[i]
        row[:, SIZE : 2 * SIZE] = rows.derivatives[i] * (i >= at)
        for c in range(5):
            row[c, 2 * SIZE + c : 2 * SIZE + c + 5 * len(phi) : 5] = phi
        G.append(row)
        V = noise.covariance(rows.covariances[i], rows.derivatives[i][:, CLOCK]) + np.diag(10.0 * left * prior)
        S.append(np.linalg.inv(V))
    assert at < len(reached) < len(rows)
    A, W = np.array(G), np.array(S)
    N = np.einsum("nij,nik,nkl->jl", A, W, A)
    g = np.einsum("nij,nik,nk->j", A, W, rows.residuals[reached])
    weak = np.concatenate([np.diag(cov), [config.clock_s**2, config.scale**2]])
    N += np.diag(np.concatenate([1.0 / weak, np.full(SIZE, 1e-9), np.tile(1.0 / prior, 9)]))
    k = int(np.flatnonzero(f.used)[0])
    rest = np.r_[0:SIZE, 2 * SIZE : len(g)]
    s = np.arange(SIZE, 2 * SIZE)
    B = np.linalg.solve(N[np.ix_(rest, rest)], N[np.ix_(rest, s)])
    assert f.information[k] == pytest.approx(N[np.ix_(s, s)] - N[np.ix_(s, rest)] @ B, rel=1e-4, abs=1e-2)
    assert f.vector[k] == pytest.approx(g[s] - B.T @ g[rest], rel=1e-4, abs=1e-2)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("stamps", ["device", "arrival"])
def test_a_knock_is_found_in_time_with_its_size(seed: int, stamps: str) -> None:
    shift = np.array([0.1, -0.12, 0.12]) * 1e-3
    change = Change(KNOCK_S, tuple(shift))
    test = watched(simulate(WorldConfig(stamps=stamps, changes=(change,)), 32.0, seed))
    assert [e.kind for e in test.events] == [MOVED]
    e = test.events[0]
    assert e.found_s - KNOCK_S < 2.0
    assert abs(e.time_s - KNOCK_S) < 0.25
    assert e.model == "translation"
    assert e.translation_m == pytest.approx(shift, abs=4e-5)
    assert not e.since_start


def test_a_turn_is_named_a_turn_and_the_pose_after_it_is_the_new_one() -> None:
    turn = np.radians(0.03) * np.array([0.8, 0.6, 0.0])
    world = simulate(WorldConfig(changes=(Change(KNOCK_S, rotation_rad=tuple(turn)),)), 36.0, 3)
    test = watched(world)
    (e,) = test.events
    assert (e.kind, e.model) == (MOVED, "rotation")
    assert e.rotation_rad == pytest.approx(turn, abs=np.radians(0.006))
    # the recalibrated pose sees the flange after the knock where the robot has it, as the old one did before
    X, cov = test.current()
    now = world.rows.times > KNOCK_S + 1.0
    seen = world.rows.centers
    p_BR = (world.X_BC.rotation().matrix() @ seen.T).T + world.X_BC.translation() - world.rows.residuals[:, :3]
    old, new = (np.linalg.norm(((Y @ seen[now].T).T - p_BR[now]).mean(axis=0)) for Y in (world.X_BC, X))
    assert old > 2.0e-4
    assert new < 0.8e-4
    assert np.linalg.eigvalsh(cov).min() > 0.0


@pytest.mark.parametrize("stamps", ["device", "arrival"])
def test_a_quiet_cell_raises_no_alarm(stamps: str) -> None:
    test = watched(simulate(WorldConfig(stamps=stamps), 40.0, 5))
    assert test.events == []
    assert not test.alarmed


def test_frames_that_show_something_else_for_a_moment_raise_no_alarm() -> None:
    world = simulate(WorldConfig(), 32.0, 6)
    wrong = world.rows.residuals.copy()
    rng = np.random.default_rng(0)
    wrong[400:420, :3] += 1e-3 * rng.standard_normal((20, 3))
    test = watched(world, replace(world.rows, residuals=wrong))
    assert test.events == []


def test_where_a_full_field_does_not_reach_a_frame_says_nothing() -> None:
    """Taken for noise, what scanner and arm err by at a new place would become a move."""
    rows = simulate(WorldConfig(outliers=0.0), 30.0, 4).rows
    f = DriftFilter(1e-8 * np.eye(6), FilterConfig(field=FieldConfig(largest=8)))
    noise, learnt = FrameNoise(2.0, 2.0, 1e-4), []
    for i in range(len(rows)):
        before = f.error, f.frames.copy(), f.vector.copy()
        f.update(rows, i, noise, spawn=i == 0)
        learnt.append(bool((f.frames > before[1]).any()))
        if not learnt[-1]:
            assert f.error == pytest.approx(before[0], abs=0.0)
            assert f.vector == pytest.approx(before[2], abs=0.0)
    assert learnt[:8] == [True] * 8
    assert 0.05 < np.mean(learnt) < 0.9, "the path leaves what three features reach, and comes back"
    assert f.novel > 5.0


def test_the_noise_rises_at_once_and_falls_slowly() -> None:
    """What is measured in some hundred frames varies; the test does not count in sigmas of the quietest."""
    usual, loud = (simulate(WorldConfig(centre_m=f * 3.5e-5, depth_m=f * 2e-5), 60.0, 8) for f in (1.0, 3.0))

    def noises(first: FeatureWorld, then: FeatureWorld, seconds: float) -> tuple[FrameNoise, FrameNoise]:
        test = DriftTest(first.X_BC, first.covariance, first.pivot)
        seen = []
        for world in (first, then):
            rows = replace(world.rows, covariances=usual.rows.covariances)
            rows = rows.part(slice(int(np.searchsorted(rows.times, rows.times[0] + seconds))))
            test.update(replace(rows, times=rows.times + (seconds if seen else 0.0)))
            assert test.noise is not None
            seen.append(test.noise)
        return seen[0], seen[1]

    before, after = noises(usual, loud, 30.0)
    assert after.center > 2.0 * before.center
    before, after = noises(loud, usual, 60.0)
    assert after.center > 0.5 * before.center


def test_a_clock_that_jumps_is_no_move() -> None:
    world = simulate(WorldConfig(), 32.0, 7)
    late = world.rows.residuals + 4e-3 * (world.rows.times > KNOCK_S)[:, None] * world.rows.derivatives[:, :, CLOCK]
    assert float(np.abs(late - world.rows.residuals).max()) > 6e-4
    assert watched(world, replace(world.rows, residuals=late)).events == []


def test_a_creep_is_found_before_it_has_reached_a_fifth_of_a_millimetre() -> None:
    creep = Change(60.0, (2e-4, 0.0, 0.0), over_s=600.0)
    test = watched(simulate(WorldConfig(frame_s=0.25, changes=(creep,)), 600.0, 8))
    assert test.events
    e = test.events[0]
    assert 60.0 < e.found_s < 60.0 + 500.0
    assert e.translation_m[0] > 5e-5
    assert all(e.kind in (MOVED, CREEP) for e in test.events)


def test_a_warm_up_is_no_move() -> None:
    warm = Change(100.0, scale=1.5e-3, over_s=300.0)
    test = watched(simulate(WorldConfig(frame_s=0.25, cube_m=0.3, changes=(warm,)), 500.0, 9))
    assert [e.kind for e in test.events if e.kind != WARM_UP] == []
    assert test.events
    assert test.events[0].scale > 0.0


def test_the_noise_is_measured_from_the_frames() -> None:
    noise = measured_noise(simulate(WorldConfig(stated=0.5), 30.0, 10).rows)
    assert noise is not None
    assert noise.center == pytest.approx(2.0, rel=0.12)
    assert noise.normal == pytest.approx(2.0, rel=0.12)
    assert noise.jitter_s < 3e-4


def test_jitter_is_measured_along_the_motion() -> None:
    noise = measured_noise(simulate(WorldConfig(stamps="arrival", stated=0.5), 30.0, 10).rows)
    assert noise is not None
    assert noise.jitter_s == pytest.approx(0.015, rel=0.2)
    # across the motion acceleration leaves a part of it, of the square of the jitter
    assert 1.8 < noise.center < 3.5
