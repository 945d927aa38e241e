"""What disturbs a set of scans is named first, and a good set has no cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.calibration.doctor.case import case_text, read_case
from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.models.errors import InputError
from weldcal.tools.report.doctor import CHECKED, worded
from weldcal.tools.worlds.doctor import CAUSES, UNKNOWN, clean

SEED = 31


@pytest.mark.parametrize("cause", CAUSES)
def test_an_injected_cause_is_named_first_with_its_evidence_and_a_next_step(cause: str) -> None:
    report = worded("a set", diagnose(CAUSES[cause](SEED)))
    first = report.causes[0]
    assert first.name == cause
    assert cause in CHECKED
    assert 0.5 < first.confidence <= 1.0
    assert first.evidence.endswith(".")
    assert first.next.endswith(".")


@pytest.mark.parametrize("fault", list(UNKNOWN)[:5])
def test_another_mistake_of_a_laboratory_is_named_too(fault: str) -> None:
    assert worded("a set", diagnose(UNKNOWN[fault](SEED))).causes[0].name == fault


def test_rotations_without_meaning_are_unexplained() -> None:
    first = worded("a set", diagnose(UNKNOWN["rotations without meaning"](SEED))).causes[0]
    assert first.name == "unexplained"
    assert "centres agree" in first.evidence


@pytest.mark.parametrize("seed", [41, 42])
def test_a_good_set_has_no_cause(seed: int) -> None:
    assert diagnose(clean(seed)).causes == ()


def test_scans_that_agree_with_nothing_are_unexplained_and_not_given_a_wrong_name() -> None:
    case = clean(SEED)
    rng = np.random.default_rng(1)
    case = replace(case, c=case.c + rng.normal(0.0, 0.02, case.c.shape))
    (only,) = worded("a set", diagnose(case)).causes
    assert only.name == "unexplained"


def test_too_few_scans_are_said_to_be_too_few() -> None:
    assert [cause.name for cause in diagnose(clean(SEED).pick(np.arange(3))).causes] == ["too few scans"]


def test_a_table_of_observations_is_read_back_as_the_same_case(tmp_path: Path) -> None:
    case = replace(clean(SEED), refused=(("scan99", "no flange"),), near_far=(0.4, 0.9))
    path = tmp_path / "observations.csv"
    path.write_text(case_text(case))
    found = read_case(path)
    for name in ("X_BF", "c", "m", "X_FR", "noise", "coverage", "guess"):
        np.testing.assert_allclose(getattr(found, name), getattr(case, name), atol=1e-12, err_msg=name)
    for name in ("ids", "robot", "flange", "guess_radius", "near_far", "oriented"):
        assert getattr(found, name) == getattr(case, name)
    assert [id for id, _ in found.refused] == ["scan99"]


@pytest.mark.parametrize(("old", "new"), [("scan01,", "scan01,x"), ("id,x,y", "id,a,b")])
def test_a_damaged_table_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "observations.csv"
    path.write_text(case_text(clean(SEED)).replace(old, new, 1))
    with pytest.raises(InputError):
        read_case(path)
