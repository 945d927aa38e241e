"""The study of registration in its short form: a scene with clutter, a plan, a subject to refuse, and the verdicts."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.figures.parts import registration
from tests.figures.parts.registration import NEES_BOUND
from tests.worlds.parts.scans import REFUSALS, scan_scene, subject
from weldcal.models.scanners import get_scanner
from weldcal.welding.locate.part.result import PartRegistration

pytest.importorskip("OCP")


def test_a_scene_is_registered_and_scored_against_its_truth() -> None:
    (trial,) = [t for t in registration.clutter_trials([28]) if t[1] == "bracket"]
    row = registration.run(*trial)
    assert (row["part"], row["verdict"]) == ("bracket", "right")
    assert 0.0 < row["seam_max_mm"] < 0.3
    assert row["nees"] < NEES_BOUND
    assert registration.summed([row])["clutter"]["right"] == 1


def test_a_wrong_pose_and_a_wrong_reason_hold_the_study(monkeypatch: pytest.MonkeyPatch) -> None:
    """The truth judges: a pose 1 mm off that claims 0.1 mm is wrong, though it says the best of itself."""

    def confident(cloud: object, mesh: object, seam: object, *_: object, **__: object) -> object:
        part = subject("lap")
        true = scan_scene(part.mesh, get_scanner("phoxi_m", 824), 6000, objects=4, fingers=1).X_BP
        off = true @ RigidTransform([0.001, 0.0, 0.0])
        said = PartRegistration(
            X_BP=off,
            covariance=np.eye(6) * 1e-8,
            rms_m=1e-4,
            agreement=1.0,
            seen=1.0,
            confidence=1.0,
            summary="high confidence",
        )
        return said, type("Joint", (), {"seam": part.seam, "share": 1.0})

    monkeypatch.setattr(registration, "locate_part", confident)
    (trial,) = registration.plan_trials([0], ["lap"])
    assert registration.summed([registration.run(*trial)])["plan"]["wrong"] == 1


def test_subjects_must_be_refused_for_the_right_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    assert registration.run_refusal("wrong unit", 0)["verdict"] == "refused: PartNotFound"
    case = REFUSALS["wrong unit"]()
    other = type(case)(case.there, case.looked_for, case.error, "looks the same")
    monkeypatch.setitem(REFUSALS, "wrong unit", lambda: other)
    assert registration.run_refusal("wrong unit", 0)["verdict"] == "wrong reason"
