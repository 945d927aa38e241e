"""The study of registration in its short form: a scene with clutter, a plan, a subject to refuse, and the verdicts."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.figures.parts import registration
from tests.figures.parts.registration import NEES_BOUND, run_registration_study
from tests.worlds.parts.scans import REFUSALS, scan_scene, subject
from weldcal.models.scanners import get_scanner
from weldcal.welding.locate.part.result import PartRegistration

pytest.importorskip("OCP")


def test_a_scene_is_registered_and_scored_against_its_truth(tmp_path: Path) -> None:
    found = run_registration_study(tmp_path, range(28, 29), range(0), range(0), ["bracket"])
    assert found["state"] == "done"
    assert found["clutter"]["scenes"] == found["clutter"]["right"] == 1  # type: ignore[index]
    row = next(csv.DictReader((tmp_path / "registrations.csv").open()))
    assert (row["part"], row["verdict"]) == ("bracket", "right")
    assert 0.0 < float(row["seam_max_mm"]) < 0.3
    assert float(row["nees"]) < NEES_BOUND


def test_a_wrong_pose_and_a_wrong_reason_hold_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    found = run_registration_study(tmp_path, range(0), range(1), range(0), ["lap"])
    assert (found["state"], found["plan"]["wrong"]) == ("held", 1)  # type: ignore[index]


def test_subjects_must_be_refused_for_the_right_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    assert registration.run_refusal("wrong unit", 0)["verdict"] == "refused: PartNotFound"
    case = REFUSALS["wrong unit"]()
    other = type(case)(case.there, case.looked_for, case.error, "looks the same")
    monkeypatch.setitem(REFUSALS, "wrong unit", lambda: other)
    assert registration.run_refusal("wrong unit", 0)["verdict"] == "wrong reason"
