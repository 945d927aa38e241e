"""The first screen: which of three verdicts, at most three things that could be wrong, and the same lines on the
terminal."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.spatial.transform import Rotation

from weldcal.models.errors import InputError
from weldcal.tools import console
from weldcal.tools.cli import options
from weldcal.tools.report.first_screen import (
    CARE,
    DO_NOT,
    USE,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    ShownPose,
    Tolerance,
    after_hold,
    check_limit,
    decide,
    point_covariance,
    radius_95,
)

WITHIN = Tolerance("the error", 0.2, 0.3, "--limit-mm")
ABOVE = Tolerance("the error", 0.4, 0.3, "--limit-mm")
X = RigidTransform(RollPitchYaw(0.3, -0.7, 2.0), [0.65, -0.02, 0.94])


def screen(found: Findings) -> FirstScreen:
    """A first screen of these findings."""
    expected = ExpectedError("error at the work point, 95 %", "0.213 mm", "8 unseen poses")
    after = Next("Verify it.", "weldcal verify out NEW_SCANS")
    return FirstScreen(found, expected, after, (ShownPose("X_BC", "pose of the scanner C in the robot's base B", X),))


@pytest.mark.parametrize(
    ("found", "verdict", "words"),
    [
        (Findings(tolerance=WITHIN, unseen=8), USE, "within the tolerance of 0.300 mm (--limit-mm)"),
        (Findings(tolerance=WITHIN), USE, "The error is 0.200 mm"),
        (Findings(tolerance=ABOVE, unseen=8), DO_NOT, "above the tolerance of 0.300 mm"),
        (Findings(tolerance=replace(WITHIN, figure=np.nan), unseen=8), DO_NOT, "not known"),
        (Findings(unseen=8), CARE, "No tolerance is stated"),
        (Findings(tolerance=WITHIN, unseen=3), CARE, "only 3 unseen poses back it"),
        (Findings(tolerance=WITHIN, unseen=1), CARE, "only 1 unseen pose backs it"),
        (Findings(tolerance=WITHIN, unseen=0), CARE, "no unseen pose backs it"),
        (Findings(tolerance=WITHIN, unseen=8, concerns=["The arm is warm."]), CARE, "one thing could be wrong"),
        (Findings(tolerance=WITHIN, unseen=8, notes=["One scan was refused."]), USE, "within"),
        (Findings(against=["The tag was lost."], tolerance=WITHIN, unseen=8), DO_NOT, "The tag was lost."),
        (Findings(tolerance=ABOVE, settled=(USE, "Its own rule.")), USE, "Its own rule."),
    ],
)
def test_the_first_rule_that_applies_decides(found: Findings, verdict: str, words: str) -> None:
    decided, reason = decide(found)
    assert decided == verdict
    assert words in reason


def test_at_most_three_things_could_be_wrong_the_gravest_first() -> None:
    two = screen(Findings(against=["Held.", "Lost."], concerns=["First.", "First."]))
    assert two.concerns == ("Lost.", "First.")
    many = screen(Findings(against=["Held.", "Lost."], concerns=["First.", "Third.", "Fourth."]))
    assert many.concerns[:2] == ("Lost.", "First.")
    assert len(many.concerns) == 3
    assert many.concerns[2].startswith("2 more")


def test_what_is_good_to_know_is_not_said_to_be_wrong() -> None:
    fine = screen(Findings(tolerance=WITHIN, unseen=8, notes=["One scan was refused.", "One scan was refused."]))
    assert fine.concerns == ()
    assert fine.rows()["could be wrong"] == "Nothing that changes the verdict."
    assert fine.rows()["good to know"] == "- One scan was refused."
    assert fine.document()["good_to_know"] == ["One scan was refused."]
    both = screen(Findings(concerns=["First."], notes=["First.", "Second.", "Third.", "Fourth.", "Fifth."]))
    assert both.notes == ("Second.", "Third.", "2 more are listed in the report.")
    assert "good to know" not in screen(Findings(concerns=["First."])).rows()


LONG = "The poses hardly differ in orientation, so they cannot show a tool centre point that is set at the robot. More."


@pytest.mark.parametrize("concerns", [0, 1, 2, 5])
@pytest.mark.parametrize("notes", [0, 1, 4])
def test_the_terminal_shows_the_verdict_first_on_at_most_twelve_lines(
    capsys: pytest.CaptureFixture[str], concerns: int, notes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    found = Findings(concerns=[f"c{k} {LONG}" for k in range(concerns)], notes=[f"n{k} {LONG}" for k in range(notes)])
    options._emit_first("calibrate", screen(found), Path("out"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"calibrate: {CARE}")
    assert len(lines) <= 12, lines
    text = " ".join(" ".join(lines).split())
    assert "weldcal verify out NEW_SCANS" in text
    assert "650.000, -20.000, 940.000 mm" in text
    assert "0.213 mm" in text
    assert (f"c0 {LONG}".removesuffix(" More.") in text) == (concerns > 0), "the gravest concern is always there"


def test_every_form_of_a_pose_to_copy_is_the_same_pose() -> None:
    pose = ShownPose("X_BC", "words", X)
    (_, _, matrix), (_, _, ur), (_, _, quaternion) = pose.forms
    assert np.array(json.loads(matrix)) == pytest.approx(X.GetAsMatrix4(), abs=1e-9)
    numbers = [float(v) for v in ur.removeprefix("p[").removesuffix("]").split(",")]
    assert Rotation.from_rotvec(numbers[3:]).as_matrix() == pytest.approx(X.rotation().matrix(), abs=1e-8)
    x, y, z, qw, *q = [float(v) for v in quaternion.split(",")]
    assert [x, y, z] == pytest.approx(numbers[:3])
    assert [x, y, z] == pytest.approx(X.translation())
    assert Rotation.from_quat([*q, qw]).as_matrix() == pytest.approx(X.rotation().matrix(), abs=1e-8)


def test_the_error_of_a_mapped_point_is_that_of_drawn_poses() -> None:
    rng = np.random.default_rng(0)
    root = 1e-4 * rng.standard_normal((6, 6)) + np.diag([1e-3] * 3 + [1e-4] * 3)
    p_C = np.array([0.05, -0.1, 0.7])
    drawn = rng.standard_normal((20_000, 6)) @ root.T
    turned = Rotation.from_rotvec(drawn[:, :3]).apply(X.rotation().matrix() @ p_C)
    off = turned + drawn[:, 3:] + X.translation() - np.asarray(X @ p_C)
    S = point_covariance(X, root @ root.T, np.asarray(X @ p_C))
    assert np.cov(off.T) == pytest.approx(S, rel=0.05, abs=0.03 * float(np.trace(S)))
    assert np.mean(np.linalg.norm(off, axis=1) < radius_95(S)) == pytest.approx(0.95, abs=0.01)


def test_a_run_that_the_operator_ended_has_no_fault_to_look_for() -> None:
    assert after_hold(True).text.startswith("The operator ended this run.")
    assert after_hold(False).text.startswith("Remove the cause")


@pytest.mark.parametrize("width", [60, 100])
def test_the_terminal_wraps_between_words_and_keeps_what_is_copied_whole(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    shown = screen(
        Findings(tolerance=WITHIN, unseen=8, concerns=["The scanner was moved by an operator. " * 4, "Second."])
    )
    console.emit_summary("In short", shown.rows())
    said = capsys.readouterr().out
    for row in shown.rows().values():
        assert " ".join(row.split()) in " ".join(said.split())
    assert shown.poses[0].forms[1][2] in said  # the UR pose, on one line
    copied = ("p[", "weldcal")
    lines = [line for line in said.splitlines() if not any(word in line for word in copied)]
    assert max(map(len, lines)) <= width


def test_several_warnings_stand_on_lines_of_their_own() -> None:
    assert console.rows({"warnings": ["One; or two.", "Three."]}) == {"warnings": "One; or two.\nThree."}


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_that_is_none_is_refused(limit: float) -> None:
    with pytest.raises(InputError, match="limit must be a positive number"):
        check_limit(limit)


def test_a_stage_that_lasts_is_told_by_tenths_and_a_count_is_no_new_stage(capsys: pytest.CaptureFixture[str]) -> None:
    with console.progress_bar("demo") as report:
        for mm in range(301):
            report(f"weld, {mm} of 300 mm", 0.38 + 0.58 * mm / 300)
    lines: list[Any] = capsys.readouterr().err.splitlines()
    assert 6 <= len(lines) <= 8
    assert "weld, 0 of 300 mm" in lines[0]
