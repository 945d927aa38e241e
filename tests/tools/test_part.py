"""`weldcal part`: the table, the JSON and the pictures of a part's edges."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from weldcal.tools.cli.app import app
from weldcal.tools.worlds.parts.step_parts import PARTS


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, _ = PARTS["two_solids"]().write(tmp_path_factory.mktemp("part"))
    return path


def test_the_json_lists_every_edge(step: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["part", str(step), "--units", "mm", "--json", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert (found["state"], found["unit"], found["bodies"]) == ("done", "mm", 2)
    assert found["size_mm"] == pytest.approx([180.0, 120.0, 70.0], abs=1e-6)
    assert [edge["id"] for edge in found["edges"]] == list(range(1, 25))
    assert set(found["edges"][0]) == {"id", "kind", "length_mm", "angle_deg", "radius_mm", "start", "end"}
    concave = [edge for edge in found["edges"] if edge["kind"] == "concave"]
    assert len(concave) == 2  # the web stands on the plate as a body of its own
    for edge in concave:
        assert edge["length_mm"] == pytest.approx(180.0, abs=1e-6)
        assert edge["angle_deg"] == pytest.approx(90.0, abs=1e-6)
        assert edge["radius_mm"] is None
        assert {round(edge["start"][0], 3), round(edge["end"][0], 3)} == {-90.0, 90.0}
    assert (tmp_path / "edges.png").stat().st_size > 20_000
    page = (tmp_path / "report.html").read_text()
    assert "2 concave edges" in page
    assert len((tmp_path / "edges.csv").read_text().splitlines()) == 25


def test_the_table_puts_the_concave_edges_first(step: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["part", str(step), "--out", str(tmp_path)])
    rows = [line.split() for line in result.stdout.splitlines()[2:]]
    assert [row[1] for row in rows[:3]] == ["concave", "concave", "convex"]
    assert rows[0][2:4] == ["180.00", "90.0"]


@pytest.mark.parametrize(
    ("arguments", "says"), [(["--units", "m"], "is in mm"), (["--units", "feet"], "units must be")]
)
def test_a_mistake_is_a_sentence(step: Path, arguments: list[str], says: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["part", str(step), *arguments, "--out", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert says in result.output
    assert not (tmp_path / "out").exists()
