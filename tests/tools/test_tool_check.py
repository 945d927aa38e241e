"""`weldcal tool check`: what it understood of a tool, its drawing, and one sentence for a tool that cannot be."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from tests.calibration.tool.torches import Wrong, cell, written
from weldcal.models.tools.loading import WELDING, check_sight, load_tool
from weldcal.tools.cli.app import app
from weldcal.tools.report.tool import ToolCheck


def test_a_tool_is_told_and_drawn(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(WELDING.read_text().replace("-60.0, 0.0, 171.5", "-70.0, 10.0, 171.5"))
    found = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out"), "--json"])
    assert found.exit_code == 0, found.output
    told = json.loads(found.stdout.strip().splitlines()[-1])
    assert told["state"] == "done"
    assert told["torch"]["xyz_mm"] == [-70.0, 10.0, 171.5]
    assert round(told["torch"]["behind_tip_mm"], 3) == 70.711
    assert told["feature"] == "tool_ring"
    assert round(told["tag"]["side_px"], 1) == 112.5  # 450 px * 10 mm / 40 mm
    picture = cv2.imread(str(tmp_path / "out/tool.png"))
    assert picture is not None
    assert picture.std() > 20.0
    page = (tmp_path / "out/tool.html").read_text()
    assert "70.7 mm behind the tip" in page
    assert "data:image/png" in page
    shown = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out"), "--overwrite"])
    assert "wire point at (-70, 10, 171.5) mm, 70.7 mm behind the tip" in " ".join(shown.output.split())


@pytest.mark.parametrize("name", ["welding", "tip_1p5", "pipe"])
def test_a_shipped_tool_passes_and_its_next_command_works(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text((WELDING.parent / f"{name}.yaml").read_text())
    found = CliRunner().invoke(app, ["tool", "check", "mine.yaml", "--out", "out"])
    first, *rest = found.stdout.splitlines()
    assert first == "tool check: use it: nothing in mine.yaml contradicts its drawing"
    assert len(rest) < 12
    assert "note" not in found.stdout
    assert "out/tool.html" in found.stdout
    assert "<title>Use it: nothing in mine.yaml contradicts its drawing</title>" in Path("out/tool.html").read_text()
    (command,) = re.findall(r"weldcal new .*", found.stdout)
    made = CliRunner().invoke(app, shlex.split(command)[1:])
    assert made.exit_code == 0, made.output


MISTAKES = {
    "wire of the other side": (
        ("xyz_mm: [-60.0, 0.0, 171.5] # the wire point", "xyz_mm: [60.0, 0.0, 171.5]"),
        "post+1, is 54 mm away. With the other sign of its x it is at torch_wire: correct torch.xyz_mm.",
    ),
    "wire beside its body": (
        ("xyz_mm: [-60.0, 0.0, 171.5] # the wire point", "xyz_mm: [-60.0, 30.0, 171.5]"),
        "torch_body, is 21 mm away. Correct torch.xyz_mm or the body of the torch.",
    ),
    "arm of the torch off": (
        (
            "torch_arm, box_mm: [80.0, 30.0, 12.0], xyz_mm: [-40.0, 0.0, 18.0]",
            "torch_arm, box_mm: [80.0, 30.0, 12.0], xyz_mm: [-40.0, 0.0, 400.0]",
        ),
        "Bodies torch_arm, torch_body, torch_wire: 13 mm away from the flange and all that it carries.",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_tool_that_contradicts_its_drawing_is_named(name: str, tmp_path: Path) -> None:
    (wrote, writes), says = MISTAKES[name]
    text = WELDING.read_text()
    assert wrote in text
    (tmp_path / "mine.yaml").write_text(text.replace(wrote, writes))
    words = ["tool", "check", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "out")]
    shown = " ".join(CliRunner().invoke(app, words).stdout.split())
    assert "tool check: use with care: a statement in mine.yaml contradicts its drawing" in shown
    assert says in shown
    told = json.loads(CliRunner().invoke(app, [*words, "--overwrite", "--json"]).stdout.splitlines()[-1])
    assert told["verdict"] == "use with care"
    assert len(told["contradictions"]) == 1


def test_all_bodies_off_the_flange_are_one_sentence(tmp_path: Path) -> None:
    """The drawing of a CAD whose origin is not the flange: 40 mm below it."""
    text = WELDING.read_text()
    head, shapes = text.split("shapes:")
    moved = re.sub(r"(xyz_mm: \[[-\d.]+, [-\d.]+, )([\d.]+)", lambda m: f"{m[1]}{float(m[2]) + 40.0}", shapes)
    (tmp_path / "mine.yaml").write_text(f"{head}shapes:{moved}")
    loaded = load_tool(tmp_path / "mine.yaml")
    (sentence,) = ToolCheck(loaded, check_sight(loaded), None).contradictions
    assert sentence.startswith(
        "Bodies mount, bar, ring_base, camera, post-1, post+1, torch_arm, torch_body, torch_wire"
    )
    assert "40 mm away from the flange" in sentence


@pytest.mark.parametrize(("beside_mm", "contradicts"), [(8.9, 0), (9.6, 1)])
def test_a_wire_within_the_nozzle_is_no_mistake(beside_mm: float, contradicts: int, tmp_path: Path) -> None:
    """A bent wire, of a drawing that has only the nozzle of 18 mm."""
    lines = [line for line in WELDING.read_text().splitlines() if "torch_wire" not in line]
    text = "\n".join(lines).replace(
        "[-60.0, 0.0, 171.5] # the wire", f"[{-60.0 - 9.0 - beside_mm}, 0.0, 171.5] # the wire"
    )
    (tmp_path / "mine.yaml").write_text(text)
    loaded = load_tool(tmp_path / "mine.yaml")
    assert len(ToolCheck(loaded, check_sight(loaded), None).contradictions) == contradicts


def test_the_height_of_the_torch_has_no_sign(tmp_path: Path) -> None:
    rows = ToolCheck(load_tool(WELDING), check_sight(load_tool(WELDING)), None).rows()
    assert "60.0 mm behind the tip and 1.5 mm below it" in rows["torch"]


def test_scans_alone_do_not_judge_the_wire(tmp_path: Path) -> None:
    written(cell(11, Wrong(), scans=8, touches=8), tmp_path)
    words = [
        "tool",
        "measure",
        str(tmp_path / "scans"),
        "--calibration",
        str(tmp_path / "result"),
        "--tool",
        str(WELDING),
    ]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert found.exit_code == 0, found.output
    shown = " ".join(found.stdout.split())
    assert "The nozzle is in place" in shown
    assert "The wire was not touched: whether the seam tolerance of 0.5 mm holds is not known." in shown
    assert "wire point not measured" in shown
    assert re.search(r"wire point +\(", shown) is None
    assert "Whether the seam tolerance holds is not known" in (tmp_path / "out/report.html").read_text()
    # the printed next step, with the touches that it asks for
    (command,) = re.findall(r"weldcal tool measure .*", found.stdout)
    again = command.replace("wire_touches.csv", str(tmp_path / "touches.csv"))
    touched = CliRunner().invoke(app, [*shlex.split(again)[1:], "--out", str(tmp_path / "again")])
    assert touched.exit_code == 0, touched.output
    assert "The seam tolerance of 0.5 mm holds." in " ".join(touched.stdout.split())


def test_a_tool_that_cannot_be_is_one_sentence_and_no_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(WELDING.read_text().replace("radius_mm: 2.5", "radius: 2.5"))
    found = CliRunner().invoke(app, ["tool", "check", str(file), "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "'mine.yaml': tip.radius is not a known key: did you mean radius_mm?" in found.output
    assert not (tmp_path / "out").exists()


def test_a_bent_torch_is_said_and_its_file_written(tmp_path: Path) -> None:
    written(cell(11, Wrong(bend=2e-3, tilt=0.013), scans=8, touches=8), tmp_path)
    given = ["--calibration", str(tmp_path / "result"), "--touches", str(tmp_path / "touches.csv")]
    words = ["tool", "check", str(WELDING), "--measure", str(tmp_path / "scans"), *given, "--json"]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert found.exit_code == 1, found.output
    told = json.loads(found.stdout.strip().splitlines()[-1])
    assert told["tolerance"] == "does not hold"
    assert told["cause"].startswith("The torch is bent: its axis is turned by 0.7")
    assert abs(told["moved"]["wire"]["by_mm"] - 2.0) < 0.15
    assert told["moved"]["wire"]["moved"]
    assert not told["moved"]["tip"]["moved"]
    measured = load_tool(tmp_path / "out/tool.yaml")
    assert abs(1e3 * measured.p_FW - told["torch"]["xyz_mm"]).max() < 1e-3
    assert "The torch is bent" in (tmp_path / "out/report.html").read_text()


def test_what_measuring_needs_is_said_before_any_work(tmp_path: Path) -> None:
    scans = ["tool", "check", str(WELDING), "--measure", str(tmp_path)]
    found = CliRunner().invoke(app, [*scans, "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "--measure needs --calibration RESULT" in found.output
    assert not (tmp_path / "out").exists()
