"""The first screens of all commands on a terminal of 80 columns: complete, the verdict first, one verdict for one
state, and exit code 1 for "do not use"."""

from __future__ import annotations

import itertools
import shlex
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import typer

from tests.documents.props import lay_out, needs_data
from tests.places import SHARED_DATA, require_data
from tests.terminal import COLUMNS, Shown, remaining, run_in_terminal
from tests.tools.report.small_outcomes import PAGES, Made, calibration
from weldcal.tools.cli import options
from weldcal.tools.report.first_screen import (
    CARE,
    DO_NOT,
    USE,
    ExpectedError,
    Findings,
    FirstScreen,
    Next,
    Tolerance,
    verify_next,
)

# Command lines that end with a verdict.
JUDGED = (
    "calibrate my_scans --out my-calibration",
    "calibrate my_scans --limit-mm 0.01 --out missed",
    "verify my-calibration other_scans --out verified",
    "verify my-calibration other_scans --limit-mm 0.001 --out refuted",
    "verify eMc.yaml pairs.npz --mounting eye_in_hand",
    "verify eMc.yaml fixed_camera.npz --mounting eye_on_base",
    "verify touched-calibration --touch touched_points.csv",
    "hand-eye ax-xb pairs.npz --mounting eye_in_hand",
    "hand-eye ax-yb pairs.npz --mounting eye_in_hand --robot ur10e",
    "hand-eye ax-yb pairs.npz --mounting eye_in_hand --limit-mm 0.01",
    "hand-eye ax-yb my_pictures --mounting eye_in_hand --board chessboard:9x6:25",
    "hand-eye axb-ycz two_robots.npz",
    "profiler edge edge.npz",
    "profiler sphere sphere.npz --limit-mm 0.01 --out my-profiler",
    "profiler seam groove.npz --calibration my-profiler --limit-mm 0.01",
    "profiler bead bead.npz --calibration my-profiler --limit-mm 0.01",
    "tablet calibrate touches.csv --poses poses.csv --camera camera.yaml --seen seen.csv",
    "tablet calibrate touches.csv --poses poses.csv --camera camera.yaml --seen seen.csv --limit-mm 0.01",
)
# Command lines that end with rows or a table.
OTHERS = (
    "doctor my-calibration",
    "profiler compensate sphere.npz",
    "tool check my_tool.yaml --out drawing",
    "tool measure shown/scans --calibration torch_result --tool my_tool.yaml --touches wire_touches.csv --out measured",
    "apply my-calibration my_scans/clouds/pose03.npz scan_C.ply",
    "export my-calibration --ros2 my_scanner_tf",
    "import my_scans --out imported",
    "robots",
    "robots ur10e",
    "new my_cell",
    "check-robot 127.0.0.9",
)
VERBOSE = (
    "hand-eye ax-yb pairs.npz --mounting eye_in_hand --robot ur10e -v --out hand_eye_v",
    "calibrate my_scans -v --out calibrate_v",
)
COPIED = ("p[", "weldcal ", "[[")


@cache
def made(name: str) -> Made:
    """The stored outcome of a command."""
    return PAGES[name]()


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Shown]:
    """Each command line and what it left on one terminal of 80 columns."""
    folder = tmp_path_factory.mktemp("terminal")
    lines = [line for line in (*JUDGED, *VERBOSE, *OTHERS) if SHARED_DATA.exists() or not needs_data(line)]
    for line in lines:
        lay_out(line, folder, ("my-calibration", "my-profiler", "my_cell"))
    return dict(zip(lines, run_in_terminal([shlex.split(line) for line in lines], folder), strict=True))


def of(shown: dict[str, Shown], line: str) -> Shown:
    """What a command line left; the test is skipped where measured data are not here."""
    if line not in shown:
        require_data(SHARED_DATA)
    return shown[line]


def check_complete(lines: list[str]) -> None:
    """Nothing is cut: no ellipsis, and no line wider than the terminal but what is copied."""
    assert not [line for line in lines if "…" in line]
    words = [line for line in lines if len(line) > COLUMNS and len(line.split()[-1]) < 40]
    assert not [line for line in words if not any(text in line for text in COPIED)]


@pytest.mark.parametrize("line", JUDGED)
def test_a_first_screen_has_twelve_lines_the_verdict_first(shown: dict[str, Shown], line: str) -> None:
    screen = of(shown, line)
    lines = [text for text in screen.lines if not text.startswith("weldcal: The verdict is: ")]
    title, _, verdict = lines[0].partition(": ")
    assert line.startswith(title)
    assert verdict in (USE, CARE, DO_NOT)
    assert len(lines) <= options.MOST_LINES, lines
    check_complete(lines)
    names = [text.split()[0] for text in lines if text.startswith("  ") and text[2] != " "]
    assert names[0] == "why"
    assert {"result", "could", "next", "report"} <= set(names)
    assert screen.code == (verdict == DO_NOT)
    assert (verdict == DO_NOT) == (screen.lines[-1] == f"weldcal: The verdict is: {DO_NOT}.")


@pytest.mark.parametrize("line", OTHERS)
def test_other_screens_are_complete_and_end_well(shown: dict[str, Shown], line: str) -> None:
    screen = of(shown, line)
    check_complete(screen.lines)
    assert screen.lines
    assert screen.code == line.startswith("check-robot")


@pytest.mark.parametrize("line", VERBOSE)
def test_verbose_adds_and_loses_nothing(shown: dict[str, Shown], line: str) -> None:
    screen = of(shown, line)
    plain = of(shown, next(text for text in JUDGED if text.split()[:2] == line.split()[:2] and "limit" not in text))
    if line.startswith("hand-eye"):
        plain = of(shown, "hand-eye ax-yb pairs.npz --mounting eye_in_hand --robot ur10e")
    verdict = plain.lines[0].partition(": ")[2]
    text = screen.text
    assert f"verdict {verdict}." in text
    assert "report.html" in text
    figure = next(row for row in plain.lines if row.startswith("  result")).split(": ")[1]
    assert figure in text
    assert "UR pose p[" in text
    assert len(screen.lines) > 2 * len(plain.lines)
    assert "next" in text


def test_hand_eye_names_the_next_pose_and_the_sigma(shown: dict[str, Shown]) -> None:
    text = of(shown, "hand-eye ax-yb pairs.npz --mounting eye_in_hand --robot ur10e").text
    assert "next Add the pose with the flange at (" in text
    assert "one sigma 0." in text
    assert "X_BM" not in text
    assert "discord" not in text
    both = of(shown, "hand-eye axb-ycz two_robots.npz").text
    assert "X_BD" in both
    assert "X_EM" not in both


def test_calibrate_says_how_many_scans_and_where_the_forms_are(shown: dict[str, Shown]) -> None:
    text = of(shown, "calibrate my_scans --out my-calibration").text
    assert "scans used 12 of 12; the scanner is " in text
    assert "UR and ROS 2 ur_pose.script, static_transform.sh" in text
    assert calibration().first.more["scans used"].startswith("9 of 10; refused: p99 (No flange was found);")


@pytest.mark.parametrize("name", PAGES)
def test_a_stored_outcome_fits_the_terminal(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    first, _ = made(name)
    options._emit_first(name, first, Path("weldcal-out") / f"{name}-s_groove-seed0")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{name}: {first.verdict}"
    assert len(lines) <= options.MOST_LINES, lines
    check_complete(lines)
    text = " ".join(" ".join(lines).split())
    assert " ".join(first.reason.split()) in text
    assert "none was computed" not in text


@pytest.mark.parametrize("verbose", [False, True])
@pytest.mark.parametrize("refused", [False, True])
@pytest.mark.parametrize("name", PAGES)
def test_do_not_use_ends_each_command_with_exit_code_1(
    name: str, refused: bool, verbose: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _ = made(name)
    if refused:
        first = replace(first, found=replace(first.found, settled=(DO_NOT, "It has moved.")))
    call = SimpleNamespace(show_result=lambda _: None, json=False, verbose=verbose, written=Path("out"))
    code = 0
    try:
        options.report(name, options.Outcome({"state": "done"}, first=first), cast(Any, call))
    except typer.Exit as ended:
        code = ended.exit_code
    assert code == (first.verdict == DO_NOT)
    assert ("The verdict is: do not use." in capsys.readouterr().err) == (first.verdict == DO_NOT)


WITHIN = Tolerance("the error", 0.2, 0.3, "--limit-mm")
ABOVE = Tolerance("the error", 0.4, 0.3, "--limit-mm")
UNKNOWN = Tolerance("the error", float("nan"), 0.3, "--limit-mm")
GENERATED = [
    Findings(against=against, tolerance=tolerance, unseen=unseen, concerns=concerns, notes=notes, settled=settled)
    for against, tolerance, unseen, concerns, notes, settled in itertools.product(
        ([], ["Held."], ["Held.", "Lost."]),
        (None, WITHIN, ABOVE, UNKNOWN),
        (None, 0, 3, 8),
        ([], ["A concern."], [f"Concern {k}." for k in range(5)]),
        ([], ["A note."], [f"Note {k}." for k in range(5)]),
        (None, (USE, "By its rule."), (CARE, "By its rule."), (DO_NOT, "By its rule.")),
    )
]
ENOUGH = Next("Stop if 0.12 mm is enough.", "weldcal view out", uses=True)


@pytest.mark.parametrize("step", [ENOUGH, verify_next("out"), Next("Add a pose.", "weldcal doctor out")])
def test_no_findings_make_parts_that_contradict_each_other(step: Next) -> None:
    verdicts = set()
    for found in GENERATED:
        first = FirstScreen(found, ExpectedError("error, 95 %", "0.2 mm", "8 poses"), step)
        verdicts.add(first.verdict)
        texts = [*first.rows().values(), *first.brief(*first.sizes[0]).values(), *map(str, first.document().values())]
        said = "\n".join([*texts, first.nothing])
        refused = first.verdict == DO_NOT
        assert ("Nothing was found" in said and refused) is False, found
        assert (step.text in said) is not (refused and step.uses), found
        assert (first.next.command == step.command) is not (refused and step.uses and bool(step.command)), found
        assert bool(first.refusal) is refused
        assert ("could be wrong, below" in first.reason) <= bool(first.concerns), found
        if first.verdict == USE:
            assert first.concerns == ()
            assert first.rows()["could be wrong"].startswith("Nothing")
        for text in (*found.concerns, *found.notes)[:1]:
            assert text in said, "nothing is lost"
    assert verdicts == {USE, CARE, DO_NOT}


def test_a_calibration_above_its_limit_does_not_advise_to_stop() -> None:
    advice = ("Stop if 0.12 mm is enough: one more pose would reduce it by 4 %.",)
    first = calibration(limit_mm=0.001, advice=advice).first
    assert first.verdict == DO_NOT
    assert "Stop" not in "\n".join(first.rows().values())
    assert first.next.text.startswith("Reduce next: ")


def test_an_erased_line_does_not_remain_and_a_written_one_does() -> None:
    assert remaining("progress 10 %\r\x1b[2Kprogress 20 %\r\x1b[2Kdone\r\nnext\x1b[0m\r\n") == ["done", "next", ""]
    assert remaining("a\nb\n\x1b[1A\x1b[2Kc") == ["a", "c", ""]


@pytest.mark.parametrize("seed", range(3))
def test_progress_never_goes_back(seed: int, capsys: pytest.CaptureFixture[str]) -> None:
    from weldcal.tools import console

    shares = np.random.default_rng(seed).uniform(-0.2, 1.2, 40)
    with console.progress_bar("demo") as report:
        for k, share in enumerate(shares):
            report(f"stage {chr(97 + k % 26)}", float(share))
    told = [int(line[1:4]) for line in capsys.readouterr().err.splitlines()]
    assert len(told) == len(shares)
    assert told == sorted(told)
    assert max(told) <= 100
