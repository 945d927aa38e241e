"""Creep and loss of a tip are recovered from a loading cycle, as exactly as the sigmas say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.worlds.loading import STEPS, LoadingTruth, cycles
from weldcal.models.tools.elastomers import TRANSITION_M, Elastomer
from weldcal.welding.finger.creep import LoadingError, LoadingEstimate, estimate_loading

PRESS_M, SETS = 0.003, 50
NOISES = (7, 17)  # two tables of each tip: the rms of fifty alone scatters by a tenth
FORCE_NOISE, TAG_NOISE_M = 0.005, 8e-6  # of the largest force; of the tag


@cache
def truth(contact_N_per_m: float) -> LoadingTruth:
    """Fifty tips."""
    rng = np.random.default_rng(5)
    return LoadingTruth(
        times_s=np.exp(rng.uniform(np.log(0.3), np.log(5.0), (SETS, 1))),
        shares=rng.uniform(0.05, 0.35, (SETS, 1)),
        loss=rng.uniform(0.05, 0.4, SETS),
        stiffness=rng.uniform(150.0, 900.0, SETS),
        sliders_m=np.full((SETS, 1), 1e-5),
        contact_N_per_m=contact_N_per_m,
    )


@cache
def recorded(contact_N_per_m: float) -> np.ndarray:
    """Their cycles: pressed in 0.75 to 3 s, held for three to five relaxation times, freed."""
    rng, time = np.random.default_rng(6), truth(contact_N_per_m).times_s[:, 0]
    return cycles(
        truth(contact_N_per_m),
        PRESS_M,
        rng.uniform(1e-3, 4e-3, SETS),
        rng.uniform(3.0, 5.0, SETS) * time,
        2 * time + 0.5,
    )


def rows(rng: np.random.Generator) -> np.ndarray:
    """Steps at which a table has its rows: 250 to 500, not quite evenly."""
    n = int(rng.uniform(250, 500))
    at = np.rint((np.arange(n) + rng.uniform(-0.3, 0.3, n)) * STEPS / n).astype(int)
    return np.unique(at.clip(0, STEPS - 1))


def estimated(i: int, kind: str, noise: int) -> LoadingEstimate:
    """The estimate from a noisy table of a tip: a force on a rigid contact, the tag on a soft one, or both."""
    rng = np.random.default_rng((noise, i))
    t, u, x, f = recorded(np.inf if kind == "force" else 3000.0)[:, rows(rng), i]
    force = f + 0.02 + FORCE_NOISE * f.max() * rng.normal(size=len(t))
    shown = x + TAG_NOISE_M * rng.normal(size=len(t))
    if kind == "force":
        return estimate_loading(t, u, force)
    return estimate_loading(t, u, None if kind == "tag" else force, shown)


@pytest.mark.parametrize("kind", ["force", "tag", "both"])
def test_errors_are_as_large_as_their_sigmas_say(kind: str) -> None:
    found = [estimated(i, kind, noise) for noise in NOISES for i in range(SETS)]
    tips = truth(np.inf)
    true = np.tile(np.column_stack([tips.times_s[:, 0], tips.shares[:, 0], tips.loss]), (len(NOISES), 1))
    got = np.array([[e.tip.relaxation_s, e.tip.creep_share, e.tip.loss_share] for e in found])
    ratio = np.sqrt(np.mean(((got - true) / [e.sigmas for e in found]) ** 2, axis=0))
    assert (ratio <= 1.3).all(), ratio
    assert (ratio >= 0.7).all(), ratio
    assert np.median(np.abs(got[:, 0] / true[:, 0] - 1.0)) < 0.03  # and they say something
    assert np.median(np.abs(got[:, 1:] - true[:, 1:]), axis=0).max() < 0.01


def one(**changes: object) -> tuple[LoadingTruth, np.ndarray]:
    """A tip with other numbers, and its cycle (4, n) of 400 rows."""
    tip = LoadingTruth(
        stiffness=np.array([300.0]), times_s=np.array([[1.0]]), shares=np.array([[0.2]]), loss=np.array([0.2]),
        sliders_m=np.array([[1e-5]]),
    )  # fmt: skip
    tip = replace(tip, **changes)  # type: ignore[arg-type]
    return tip, cycles(tip, PRESS_M, np.array([0.002]), np.array([6.0]), np.array([3.0]))[:, :: STEPS // 400, 0]


def test_several_times_and_soft_sliders_are_named_and_do_not_spoil_the_loss() -> None:
    many = {"times_s": np.array([[0.05, 0.6, 8.0]]), "shares": np.array([[0.1, 0.1, 0.1]])}
    _, (t, u, _, f) = one(**many, sliders_m=np.array([[1e-5, 1e-4, 3e-4]]))
    found = estimate_loading(t, u, f + np.random.default_rng(0).normal(0.0, 0.002, len(t)))
    assert any("One relaxation time does not explain" in text for text in found.concerns)
    assert 0.05 < found.tip.relaxation_s < 8.0
    assert found.tip.loss_share == pytest.approx(0.2, abs=0.05)


def test_a_spring_without_memory_has_none() -> None:
    _, (t, u, _, f) = one(shares=np.array([[0.0]]), loss=np.array([0.0]))
    found = estimate_loading(t, u, f + np.random.default_rng(0).normal(0.0, 0.004, len(t)))
    assert found.tip.creep_share < 0.02
    assert any("No creep is seen" in text for text in found.concerns)
    assert "No loss is seen beyond creep." in found.concerns
    assert found.stiffness_N_per_m == pytest.approx(300.0, rel=0.02)


def test_what_the_contact_gives_way_counts_without_the_tag_and_is_said() -> None:
    _, (t, u, x, f) = one(contact_N_per_m=3000.0)
    noise = np.random.default_rng(0).normal(0.0, [[0.003], [4e-6]], (2, len(t)))
    alone, both = estimate_loading(t, u, f + noise[0]), estimate_loading(t, u, f + noise[0], x + noise[1])
    assert alone.concerns == ("Without deflection_mm what contact and robot give way counts as the tip's.",)
    assert both.concerns == ()
    assert both.tip.creep_share == pytest.approx(0.2, abs=0.005)
    assert alone.tip.creep_share < 0.19


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    """The cycle of a tip with one time."""
    return one()[1]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda t, u, f: (t[:39], u[:39], f[:39]), "has 39 rows, and 40 are needed"),
        (lambda t, u, f: (t[:250], u[:250], f[:250]), "no unloading: after 1.5 s the indentation falls by 0 % only"),
        (lambda t, u, f: (np.r_[t[:9], t[8:-1]], u, f), "Time does not grow from row 9 to row 10"),
        (lambda t, u, f: (1e3 * t, u, f), "t_s is in seconds, yours seem to be milliseconds"),
        (lambda t, u, f: (t, 1e-3 * u, f), "spans 0.003 mm: give indentation_mm in millimetres"),
        (lambda t, u, f: (t, 1e3 * u, f), "spans 3000 mm: give indentation_mm in millimetres"),
        (lambda t, u, f: (t, u, 0.0 * f + 1.0), "the same in all rows"),
        (lambda t, u, f: (30.0 * t, u, f), "The rows are 0.9.* s apart: record ten rows a second"),
        (lambda t, u, f: (t, -u, f), "The indentation is negative: give it zero at contact"),
    ],
)
def test_a_table_that_shows_nothing_is_refused_with_what_to_do(plain: np.ndarray, wrong: object, sentence: str) -> None:
    t, u, _, f = plain
    with pytest.raises(LoadingError, match=sentence):
        estimate_loading(*wrong(t, u, f))  # type: ignore[operator]


def test_a_hold_that_is_short_against_the_relaxation_is_refused() -> None:
    _, (t, u, _, f) = one(times_s=np.array([[30.0]]), shares=np.array([[0.4]]))
    with pytest.raises(LoadingError, match="the tip still creeps: its relaxation time is about"):
        estimate_loading(t, u, f)


def test_a_deflection_in_metres_is_refused(plain: np.ndarray) -> None:
    t, u, x, f = plain
    with pytest.raises(LoadingError, match=r"The tag shows 0\.003 mm for an indentation of 3 mm"):
        estimate_loading(t, u, f, 1e-3 * x)


def test_a_step_of_the_memory_is_what_many_small_ones_are() -> None:
    tip, memory, fine = Elastomer(0.7, 0.2, 0.3), np.array([[1e-3], [0.2]]), np.array([[1e-3], [0.2]])
    whole = tip.step(memory, np.array([2e-3]), np.array([2.6e-3]), 0.5)
    for x in np.linspace(2e-3, 2.6e-3, 100_001)[:-1] + 3e-9:
        v, z = fine
        fine = np.array([v + 5e-6 * (x - v) / 0.7, z + 6e-9 / TRANSITION_M * (1.0 - z)])
    assert whole == pytest.approx(fine, rel=1e-4)


def test_the_work_that_a_slow_press_loses_is_the_loss_share() -> None:
    tip = Elastomer(1.0, 0.0, 0.3)
    way = np.r_[np.linspace(0.0, 0.02, 4001), np.linspace(0.02, 0.0, 4001)[1:]]
    memory, forces = np.zeros((2, 1)), [0.0]
    for a, b in zip(way[:-1, None], way[1:, None], strict=True):
        memory = tip.step(memory, a, b, 0.01)
        forces.append(float((b - tip.rest(memory, b))[0]))
    work = np.diff(way) * (np.array(forces)[1:] + forces[:-1]) / 2.0
    assert -work[4000:].sum() / work[:4000].sum() == pytest.approx(1.0 - 0.3, abs=0.02)  # it turns over 0.3 of 20 mm


def test_a_free_tip_is_near_its_rest_after_the_time_that_is_stated() -> None:
    tip, x = Elastomer(2.0, 0.18, 0.3), np.array([3e-3])
    memory = np.array([x, [-1.0]])
    x = tip.rest(memory, x)
    for _ in range(round(tip.free_s(3e-3, 5e-5) / 1e-3)):
        before, x = x, tip.rest(memory, x)
        memory = tip.step(memory, before, x, 1e-3)
    assert float(x[0]) == pytest.approx(5e-5, abs=1e-5)
