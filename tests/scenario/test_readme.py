"""The README's promises, kept: its commands run as they are written and leave what it says."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.browser import Browser, colours
from tests.short_job import ShortJob
from weldcal.tools.cli.app import app

# Each command of the README and the test that runs it, here or in another file (with a short job, where the job is
# long).
RUN_BY = {
    "./tools/run demo": "test_the_demo_ends_done_and_leaves_the_files_that_the_readme_names",
    "./tools/run test": "test_the_commands_of_the_readme_are_run",
    "./tools/run calibrate my_scans --out my-calibration": "test_the_users_own_scans_calibrate_and_others_verify_them",
    "./tools/run verify my-calibration other_scans": "test_the_users_own_scans_calibrate_and_others_verify_them",
    "./tools/run hand-eye ax-yb pairs.npz --mounting eye_in_hand": (
        "test_a_command_without_a_simulation_does_what_the_page_says"
    ),
    "./tools/run hand-eye ax-yb my_pictures --mounting eye_in_hand --board chessboard:9x6:25": (
        "test_a_command_without_a_simulation_does_what_the_page_says"
    ),
    "./tools/run verify eMc.yaml pairs.npz --mounting eye_in_hand": (
        "test_a_command_without_a_simulation_does_what_the_page_says"
    ),
    "./tools/run demo --robot emulated": "test_the_same_calibration_on_the_emulated_robot_ends_with_the_same_figures",
    "./tools/run check-robot 192.168.56.101": "test_the_command_ends_with_1_and_the_first_sentence",
    "./tools/run demo --robot 192.168.56.101 --dry-run": (
        "test_a_dry_run_has_the_robots_kinematics_and_joints_and_sends_it_nothing"
    ),
}


@pytest.fixture(scope="module")
def readme(repository: Path) -> str:
    """The README's text."""
    return (repository / "README.md").read_text()


def blocks(readme: str, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", readme, re.MULTILINE | re.DOTALL)


def test_the_commands_of_the_readme_are_run(repository: Path, readme: str) -> None:
    assert {line for text in blocks(readme, "sh") for line in text.splitlines()} == set(RUN_BY)
    tests = "\n".join(path.read_text() for path in (repository / "tests").rglob("test_*.py"))
    assert [name for name in RUN_BY.values() if f"def {name}(" not in tests] == []


def test_the_demo_ends_done_and_leaves_the_files_that_the_readme_names(finished_demo: ShortJob, readme: str) -> None:
    assert finished_demo.returncode == 0, finished_demo.output
    assert finished_demo.summary["state"] == "done"
    promised = set(re.findall(r"`([a-z_]+\.(?:html|yaml|csv))`", readme.split("## Start")[1].split("\n## ")[0]))
    assert len(promised) >= 4
    assert promised <= {path.name for path in finished_demo.result.folder.iterdir()}


def test_the_terminal_tells_the_weld_by_millimetres_of_seam(finished_demo: ShortJob) -> None:
    told = [int(mm) for mm in re.findall(r"weld, (\d+) of 30 mm", finished_demo.output)]
    assert len(told) >= 3
    assert told == sorted(set(told))
    assert told[0] < 20 <= told[-1] <= 30


@pytest.mark.parametrize("name", ["report.html", "recording.html"])
def test_its_pages_open_without_a_network(finished_demo: ShortJob, browser: Browser, tmp_path: Path, name: str) -> None:
    ready = "document.querySelector('canvas')" if name == "recording.html" else "document.querySelector('.verdict')"
    browser.open(finished_demo.result.folder / name, wait_for=ready)
    pixels = browser.screenshot(tmp_path / "page.png", until=lambda picture: colours(picture) > 8)
    assert colours(pixels) > 8, "the page is not blank"
    assert browser.console_messages() == []
    assert browser.outside_addresses() == []


def test_the_report_says_first_whether_it_worked(finished_demo: ShortJob, browser: Browser) -> None:
    browser.open(finished_demo.result.folder / "report.html")
    verdict = str(browser.run("return document.querySelector('.verdict').innerText"))
    assert verdict
    assert browser.text().index(verdict) < 300, "the verdict stands near the top"
    assert browser.run("return [...document.images].every(image => image.naturalWidth > 100 && image.alt)")


def own_scans(source: Path, folder: Path, header: str, rows: slice) -> None:
    """A dataset as the README describes it: its dataset.yaml, some rows of measured poses, and their clouds."""
    first, *poses = (source / "poses.csv").read_text().splitlines()
    (folder / "clouds").mkdir(parents=True)
    (folder / "dataset.yaml").write_text(header)
    (folder / "poses.csv").write_text("\n".join([first, *poses[rows]]) + "\n")
    for pose in poses[rows]:
        name = f"{pose.split(',')[0]}.pcd"
        shutil.copyfile(source / "clouds" / name, folder / "clouds" / name)


def test_the_users_own_scans_calibrate_and_others_verify_them(
    shared_data: Path, readme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aubo, (header,) = shared_data / "flange/aubo_i5_phoxi_s", blocks(readme, "yaml")
    columns = re.search(r"header `(id,[a-z,]+)`", readme)
    assert columns is not None
    assert columns[1] == (aubo / "poses.csv").read_text().splitlines()[0]
    own_scans(aubo, tmp_path / "my_scans", header, slice(0, None, 2))
    own_scans(aubo, tmp_path / "other_scans", header, slice(1, None, 2))
    monkeypatch.chdir(tmp_path)
    for line in next(text for text in blocks(readme, "sh") if "calibrate" in text).splitlines():
        finished = CliRunner().invoke(app, [*shlex.split(line)[1:], "--json"])
        assert finished.exit_code == 0, finished.stderr
        summary = json.loads(finished.stdout.splitlines()[-1])
        assert summary["state"] == "done"
        if "calibrate" in line:
            clouds = list((tmp_path / "my_scans/clouds").iterdir())
            assert summary["n_used"] + len(summary["refused"]) == len(clouds)
            written = {path.name for path in (tmp_path / "my-calibration").iterdir()}
            assert {"calibration.yaml", "report.html"} <= written
    assert summary["position_error_mm"]["median"] < 0.3
    assert {pose["id"] for pose in summary["per_pose"]} == {p.stem for p in (tmp_path / "other_scans/clouds").iterdir()}
