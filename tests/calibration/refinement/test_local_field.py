"""A local field improves poses near those that it was made from, and leaves others as they are with a larger region."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.stats import chi2

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import TooFewPoses
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import bootstrap_interval, position_errors
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.refinement.local_field import (
    LocalChoice,
    LocalField,
    choose_local,
    field_from_document,
    fit_field,
    with_field,
)
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

X_BC = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.4, 0.1, 1.0])
SCAN_M = 3e-5


def _wave(p: Array) -> Array:
    """What an arm leaves (n, 3) m over 0.25 m: no kernel of a Gaussian process."""
    return 2e-4 * np.column_stack([np.sin(p[:, 1] / 0.07), np.cos(p[:, 0] / 0.08), np.sin((p[:, 0] + p[:, 2]) / 0.07)])


def _scans(n: int, seed: int, *, size: float = 1.0, turn_deg: float = 0.0, shift: float = 0.0) -> list[Observation]:
    rng = np.random.default_rng(seed)
    p = np.array([0.4, 0.1, 0.5]) + shift + 0.12 * rng.uniform(-1.0, 1.0, (n, 3))
    R = RotationMatrix.MakeZRotation(np.radians(turn_deg))
    seen = p + size * _wave(p) + SCAN_M * rng.standard_normal((n, 3))
    back = X_BC.inverse()
    normal = np.asarray(back.rotation() @ np.array([0.0, 0.0, 1.0]))
    return [Observation(f"s{seed}_{k}", RigidTransform(R, p[k]), np.asarray(back @ seen[k]), normal) for k in range(n)]


@pytest.fixture(scope="module")
def chosen() -> tuple[LocalChoice, RigidTransform]:
    scans = _scans(40, 0)
    X = estimate_eye_on_base(scans, SolveConfig(allow_coplanar=True)).X_BC
    return choose_local(scans, {}, X, ScannerCorrection(), correct_scanner=False), X


def test_new_scans_near_by_are_hit_better_and_lie_in_the_stated_region(
    chosen: tuple[LocalChoice, RigidTransform],
) -> None:
    choice, X = chosen
    assert choice.accepted, choice.sentence
    new = _scans(300, 1)
    plain, local = position_errors(X, new), position_errors(X, choice.field.applied(X, new))
    assert local.mean() < 0.6 * plain.mean()
    # what the nested errors state holds for scans that nothing saw
    assert local.mean() == pytest.approx(np.nanmean(choice.local_m), rel=0.35)
    spread = choice.field.at([o.X_BR for o in new])[1]
    inside = float(((local / spread) ** 2 < chi2.ppf(0.95, 3)).mean())
    assert 0.90 < inside <= 0.99


@pytest.mark.parametrize("elsewhere", [{"turn_deg": 50.0}, {"shift": 3.0}])
def test_elsewhere_the_plain_calibration_stays_and_the_region_grows(
    chosen: tuple[LocalChoice, RigidTransform], elsewhere: dict[str, float]
) -> None:
    field = chosen[0].field
    there = [o.X_BR for o in _scans(20, 2, **elsewhere)]
    shift, spread = field.at(there)
    assert np.abs(shift).max() < 1e-6
    np.testing.assert_allclose(spread, np.hypot(field.sigma_field_m, field.sigma_scan_m), rtol=1e-3)
    assert (
        spread.min()
        > 1.5
        * field.at([RigidTransform(R, p) for R, p in zip(map(RotationMatrix, field.turns), field.places, strict=True)])[
            1
        ].max()
    )


def test_where_nothing_is_left_the_plain_calibration_is_used() -> None:
    scans = _scans(14, 3, size=0.0)
    estimate = estimate_eye_on_base(scans, SolveConfig(allow_coplanar=True))
    choice = choose_local(scans, {}, estimate.X_BC, ScannerCorrection(), correct_scanner=False)
    assert not choice.accepted
    assert "does not help" in choice.sentence
    refined, same = with_field(estimate, choice, scans)
    assert same == scans
    np.testing.assert_array_equal(refined.held_out.position_m, choice.plain_m)


def test_few_poses_are_refused() -> None:
    with pytest.raises(TooFewPoses, match="needs 10"):
        choose_local(_scans(9, 0), {}, X_BC, ScannerCorrection())


def test_a_field_is_read_as_it_was_written(chosen: tuple[LocalChoice, RigidTransform]) -> None:
    field = chosen[0].field
    again = field_from_document(field.document())
    assert again is not None
    there = [o.X_BR for o in _scans(5, 4, turn_deg=3.0)]
    np.testing.assert_allclose(again.at(there)[0], field.at(there)[0], atol=1e-12)
    assert field_from_document(None) is None
    wrong: tuple[dict[str, object], ...] = ({"length_m": "far"}, {"places": []}, {"sigma_scan_m": 0.0})
    for broken in wrong:
        with pytest.raises(InputError, match=r"r\.yaml"):
            field_from_document({**field.document(), **broken}, "r.yaml")


def test_the_length_is_that_of_the_residuals() -> None:
    rng = np.random.default_rng(5)
    p = rng.uniform(-0.3, 0.3, (60, 3))
    places = [RigidTransform(each) for each in p]
    d = np.linalg.norm(p[:, None] - p[None], axis=2)
    for length in (0.05, 0.3):
        K = 9e-8 * np.exp(-0.5 * (d / length) ** 2) + 4e-10 * np.eye(60)
        found = fit_field(places, np.linalg.cholesky(K) @ rng.standard_normal((60, 3)))
        assert found.length_m == pytest.approx(length, rel=0.5)


def test_rounding_does_not_change_the_field() -> None:
    """Residuals that differ in the last digits, as those of two processors do."""
    scans = _scans(20, 3)
    X_BR, r = [o.X_BR for o in scans], _wave(np.array([o.X_BR.translation() for o in scans]))
    rng = np.random.default_rng(0)
    found = [fit_field(X_BR, r * (1.0 + 1e-14 * rng.standard_normal(r.shape))) for _ in range(4)]
    sizes = np.array([[f.length_m, f.sigma_field_m, f.sigma_scan_m] for f in found])
    np.testing.assert_allclose(sizes[1:] / sizes[0], 1.0, atol=1e-6)


def test_the_bootstrap_interval_holds_the_median_of_as_many_new_errors() -> None:
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        seen, new = 1e-4 * np.linalg.norm(rng.standard_normal((2, 18, 3)), axis=2)
        low, high = bootstrap_interval(seen) or (np.nan, np.nan)
        inside.append(low < np.median(new) < high)
    assert 0.90 <= np.mean(inside) <= 0.99
    assert bootstrap_interval(np.ones(3)) is None


def test_the_field_moves_what_x_bc_makes_of_a_scan_by_itself() -> None:
    scan = _scans(1, 6)[0]
    field = LocalField(
        places=np.array([scan.p_BR]),
        turns=np.array([np.eye(3)]),
        residuals=np.array([[1e-3, -2e-3, 5e-4]]),
        length_m=0.1,
        turn_rad=1.0,
        sigma_field_m=1e-3,
        sigma_scan_m=1e-6,
    )
    (moved,) = field.applied(X_BC, [scan])
    np.testing.assert_allclose(X_BC @ scan.p_CR - X_BC @ moved.p_CR, [1e-3, -2e-3, 5e-4], rtol=1e-4)
    assert replace(moved, p_CR=scan.p_CR) == scan or moved.id == scan.id
