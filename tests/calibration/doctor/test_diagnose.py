"""What disturbs a set of scans is named first, and a good set has no cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.worlds.doctor import CAUSES, clean, make_world, observe, true_poses
from weldcal.calibration.doctor.case import DoctorCase, case_text, read_case
from weldcal.calibration.doctor.diagnose import diagnose
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arms.kinematics import chain_poses
from weldcal.models.errors import InputError
from weldcal.tools.report.doctor import CHECKED, worded

SEED = 31


def _inverted(seed: int) -> DoctorCase:
    case = clean(seed)
    return case.with_poses(inverse(case.X_BF))


def _euler(seed: int) -> DoctorCase:
    case = clean(seed)
    angles = Rotation.from_matrix(case.X_BF[:, :3, :3]).as_euler("ZYX")
    return case.with_poses(pose(Rotation.from_euler("xyz", angles).as_matrix(), case.X_BF[:, :3, 3]))


def _shifted(seed: int) -> DoctorCase:
    case = clean(seed)
    return case.pick(np.arange(1, case.n)).with_poses(case.X_BF[:-1])


def _mirrored(seed: int) -> DoctorCase:
    case = clean(seed)
    flip = np.array([1.0, -1.0, 1.0])
    return replace(case, c=case.c * flip, m=case.m * flip)


def _scale(seed: int) -> DoctorCase:
    case = clean(seed)
    return replace(case, c=case.c * (1.03 if seed % 2 else 0.97))


def _encoder(seed: int) -> DoctorCase:
    world = make_world(seed)
    q = world.q.copy()
    q[:, 1 + seed % 4] += np.radians(2.5)
    return observe(world, true_poses(world), believed=chain_poses(world.believed, q))


def _shuffled(seed: int) -> DoctorCase:
    case = clean(seed)
    return case.with_poses(case.X_BF[np.random.default_rng([seed, 11]).permutation(case.n)])


def _random_turns(seed: int) -> DoctorCase:
    case = clean(seed)
    R = Rotation.random(case.n, random_state=seed).as_matrix()
    return case.with_poses(pose(R, case.X_BF[:, :3, 3]))


UNKNOWN: dict[str, Callable[[int], DoctorCase]] = {
    "poses inverted": _inverted,
    "wrong rotation convention": _euler,
    "scans and poses shifted by one": _shifted,
    "scanner axes mirrored": _mirrored,
    "scanner scale error": _scale,
    "joint zero off by 2.5 degrees": _encoder,
    "scans of other poses": _shuffled,
    "rotations without meaning": _random_turns,
}
"""What each does to a set, by seed.

Of the last three no model has the name: "unexplained", or a kinematics file, is right.
"""


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


def test_what_poses_of_one_orientation_cannot_show_is_no_all_clear() -> None:
    case = clean(3)
    turned = worded("dataset", diagnose(case))
    assert "cannot be seen" not in turned.text()
    R = np.repeat(case.X_BF[:1, :3, :3], case.n, axis=0)
    p = case.X_BF[:, :3, 3]
    X_BC = pose(np.diag([1.0, -1.0, -1.0]), np.array([0.6, 0.1, 1.0]))
    seen = inverse(X_BC) @ pose(R, p) @ case.X_FR
    alike = replace(case, X_BF=pose(R, p), c=seen[:, :3, 3], m=seen[:, :3, 2], guess=None)
    text = worded("dataset", diagnose(alike)).text()
    assert "no cause found" in text
    checked, _, unseen = text.partition("cannot be seen: ")
    assert "TCP set at the controller" not in checked
    assert "poses too alike" not in checked
    assert unseen.startswith("TCP set at the controller. The poses differ by only 0.0 degrees")
