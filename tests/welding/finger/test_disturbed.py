"""Disturbed pictures of the tag: accepted ones are right, refused ones name the cause, good ones are accepted."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from tests.welding.finger.disturbed import DEPTH_M, JUDGED_SEED, LATERAL_M, TagVerdict, judge, measured, shot, summary

COUNT = 300


@lru_cache(maxsize=1)
def verdicts() -> list[TagVerdict]:
    return [judge(shot(JUDGED_SEED + k)) for k in range(COUNT)]


def test_accepted_pictures_are_within_the_limits() -> None:
    accepted = [v for v in verdicts() if v.accepted]
    assert len(accepted) > 0.35 * COUNT
    assert not any(v.wrong for v in accepted), summary(verdicts())


def test_the_limits_refuse_what_would_be_wrong() -> None:
    """Without the limits many of the same pictures would be off by more than they allow."""
    wrong = 0
    for k in range(60):
        s = shot(JUDGED_SEED + k, ("saturation",))
        found, error = measured(s.picture, s.p_KM, limited=False)
        wrong += found.valid and (np.hypot(*error[:2]) > LATERAL_M or abs(error[2]) > DEPTH_M)
    assert wrong > 20


def test_the_stated_covariance_covers_the_error() -> None:
    accepted = [v for v in verdicts() if v.accepted]
    depth = np.array([v.depth_m / v.depth_sigma_m for v in accepted])
    # Of a Gaussian 68 and 95 % lie within one and two deviations; the tails of mixed disturbances are longer.
    assert np.mean(depth < 1.0) > 0.6
    assert np.mean(depth < 3.0) > 0.95
    assert np.median(depth) > 0.1, "the deviations are not stated much too large"


def test_good_pictures_are_accepted() -> None:
    good = [judge(shot(JUDGED_SEED + k, ("none",))) for k in range(100)]
    assert sum(v.accepted for v in good) >= 99, summary(good)
    assert max(v.depth_m for v in good) < 5e-5


@pytest.mark.parametrize(
    ("kind", "strength", "cause"),
    [("motion blur", 0.7, "blurred"), ("defocus", 0.6, "blurred"), ("saturation", 0.5, "overexposed")],
)
def test_a_refusal_names_the_cause(kind: str, strength: float, cause: str) -> None:
    refused = [v.reason for v in (judge(shot(JUDGED_SEED + k, (kind,), strength)) for k in range(20)) if not v.accepted]
    assert len(refused) >= 10
    assert sum(cause in reason for reason in refused) >= 0.7 * len(refused), refused


def test_glare_beside_the_tag_is_named_or_measured_rightly() -> None:
    some = [judge(shot(JUDGED_SEED + k, ("glare",), 0.7)) for k in range(40)]
    assert not any(v.wrong for v in some)
    assert any("glare" in v.reason for v in some)
