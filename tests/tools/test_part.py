"""`weldcal part`: the table, the JSON and the pictures of a part's edges."""

from __future__ import annotations

import json
import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from mpl_toolkits.mplot3d import proj3d
from typer.testing import CliRunner

from weldcal.models.errors import InputError
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.part import numbered, seam_count
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import part_of
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell import new
from weldcal.tools.commands.cell.new import OwnPart, write_cell
from weldcal.tools.commands.cell.part import edges_picture, with_plans
from weldcal.tools.commands.cell.screen import Seam, ranked, ways
from weldcal.tools.worlds.parts.step_parts import PARTS, assembly, box, cylinder, less, prism, write_step


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, _ = PARTS["two_solids"]().write(tmp_path_factory.mktemp("part"))
    return path


def test_the_json_lists_every_edge(step: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["part", str(step), "--units", "mm", "--json", "--plan", "0", "--out", str(tmp_path)]
    )
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
    page = (tmp_path / "seams.html").read_text()
    assert "http" not in page.replace("http-equiv", "")  # one file, no network
    scene = json.loads(re.search(r"const \{ vertices, triangles, seams \} = (.*);", page)[1])  # type: ignore[index]
    assert len(scene["triangles"]) == 24
    assert [seam["edges"] for seam in scene["seams"]] == [row["edges"] for row in found["seams"]]
    ends = {tuple(point) for seam in scene["seams"] for line in seam["lines"] for point in line}
    assert len(ends) == 4
    assert {abs(x) for x, _, _ in ends} == {90.0}


def test_the_table_puts_the_concave_edges_first(step: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["part", str(step), "--plan", "0", "--out", str(tmp_path)])
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


def write_pipe(path: Path, radius: float) -> None:
    """A pipe of 80 mm on a plate."""
    pipe = less(cylinder((0, 0, 0), radius, 80), cylinder((0, 0, -1), radius - 30, 90))
    write_step(assembly(box((-150, -150, -10), (300, 300, 10)), pipe), path)


def test_each_seam_says_whether_the_tool_fits_it(tmp_path: Path) -> None:
    write_pipe(tmp_path / "pipe.step", 80)
    result = CliRunner().invoke(
        app, ["part", str(tmp_path / "pipe.step"), "--json", "--plan", "0", "--out", str(tmp_path / "out")]
    )
    outside, inside = json.loads(result.stdout.splitlines()[-1])["seams"]
    assert [outside["type"], outside["weldable"]] == ["pipe on plate", True]
    assert outside["length_mm"] == pytest.approx(2.0 * math.pi * 80.0, abs=0.05)
    assert [outside["least_radius_mm"], inside["least_radius_mm"]] == pytest.approx([80.0, 50.0])
    assert outside["closed"]
    assert not inside["weldable"]
    assert re.search(r"tool does not fit: .* \(-\d+\.\d mm\)", inside["reason"])
    text = (
        CliRunner()
        .invoke(app, ["part", str(tmp_path / "pipe.step"), "--plan", "0", "--out", str(tmp_path / "text")])
        .stdout
    )
    assert re.search(r"pipe on plate +502\.7 +90\.0 .*  fits the tool, not planned", text)
    assert "Seams</h2>" in (tmp_path / "out" / "report.html").read_text()


def test_the_planner_refuses_in_part_what_it_refuses_in_new(tmp_path: Path) -> None:
    """Beside a web between two walls the tool fits in the middle; the way along the seam ends at a wall."""
    walls = [box((x, 0, 0), (8, 100, 60)) for x in (0, 192)]
    write_step(assembly(box((0, 0, -10), (200, 100, 10)), box((8, 46, 0), (184, 8, 60)), *walls), tmp_path / "h.step")
    shape = read_shape(tmp_path / "h.step")
    inner = next(joint for joint in shape.joints if joint.length_m == pytest.approx(0.184))
    asked = Seam(joint=inner, radius_m=None, reason="")
    found = with_plans(shape, [asked], 1, tmp_path / "h.step", None, WELDING, lambda stage, share: None)[0]
    assert found.planned
    written, reason = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "h.step", inner.edges), WELDING)
    assert written.name == "unfinished.yaml"
    assert found.verdict.startswith("no: ")
    assert found.reason in reason


def test_a_seam_with_corners_is_taken_as_a_whole(tmp_path: Path) -> None:
    """A rectangle around a low post is one seam with four corners, in `part` and in `new`."""
    write_step(assembly(box((-150, -150, -10), (300, 300, 10)), box((-50, -35, 0), (100, 70, 40))), tmp_path / "p.step")
    (joint,) = read_shape(tmp_path / "p.step").joints
    assert joint.length_m == pytest.approx(0.34)
    path, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "p.step"))
    assert note == ""
    seams = load_scenario(str(path)).workpiece.seams  # type: ignore[union-attr]
    assert [seam.edges for seam in seams] == [list(joint.edges)]


def test_where_the_whole_is_refused_a_piece_is_taken_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_step(assembly(box((-150, -150, -10), (300, 300, 10)), box((-50, -35, 0), (100, 70, 40))), tmp_path / "p.step")
    (joint,) = read_shape(tmp_path / "p.step").joints

    def only_alone(scenario: Scenario, *_: object) -> str:
        return "Too near." if len(scenario.workpiece.seams[0].edges) > 1 else ""  # type: ignore[union-attr]

    monkeypatch.setattr(new, "add_scan_poses", only_alone)
    monkeypatch.setattr(new, "weldable_place", lambda scenario, advises: (scenario.workpiece.pose_guess, ""))
    path, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "p.step"))
    (seam,) = load_scenario(str(path)).workpiece.seams  # type: ignore[union-attr]
    assert seam.edges[0] in joint.edges
    assert note == f"Only edge {seam.edges[0]} of {', '.join(map(str, joint.edges))}. As a whole: Too near."
    assert "# Only edge" in path.read_text()
    # Of edges that an operator gives nothing is left out.
    path, reason = write_cell(tmp_path / "by_hand", "s_groove", OwnPart(tmp_path / "p.step", joint.edges))
    assert (path.name, reason) == ("unfinished.yaml", "Too near.")


def test_pieces_are_named_with_the_reason_of_their_own_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two webs the longer is tried first, and refused in any way."""
    webs = box((-60, -90, 0), (120, 6, 40)), box((-40, 90, 0), (80, 6, 40))
    write_step(assembly(box((-150, -150, -10), (300, 300, 10)), *webs), tmp_path / "p.step")
    _, second = sorted(read_shape(tmp_path / "p.step").joints, key=lambda joint: -joint.length_m)

    def only_the_second_in_pieces(scenario: Scenario, *_: object) -> str:
        ids = scenario.workpiece.seams[0].edges  # type: ignore[union-attr]
        return f"Whole {min(ids)}." if len(ids) > 1 else "" if ids[0] in second.edges else "A piece."

    monkeypatch.setattr(new, "add_scan_poses", only_the_second_in_pieces)
    monkeypatch.setattr(new, "weldable_place", lambda scenario, advises: (scenario.workpiece.pose_guess, ""))
    _, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "p.step"))
    assert re.match(r"Without edges \d+, \d+, which are shorter", note)
    assert note.endswith(f"As a whole: Whole {min(second.edges)}.")


def test_the_edge_below_a_tube_is_left_out(tmp_path: Path) -> None:
    """Two tubes end to end: of the butt around them the arm reaches all but the edge that lies on the table."""
    tubes = [less(box((x, 0, 0), (100, 40, 40)), box((x - 1, 3, 3), (102, 34, 34))) for x in (0, 101)]
    write_step(assembly(*tubes), tmp_path / "tubes.step")
    shape = read_shape(tmp_path / "tubes.step")
    ring = max(shape.joints, key=lambda joint: joint.length_m)
    (below,) = (id for id in ring.edges if np.abs(shape.edge(id).points_P[:, 2]).max() < 1e-6)
    (_, _), (pieces, note), *_ = ways(shape, ring.edges)
    assert [seam.edges for seam in pieces] == [[id] for id in ring.edges if id != below]
    assert note == f"Without edges {below}, which are shorter than 20 mm or open downwards."


def test_the_outside_of_a_mitre_is_refused_with_what_to_do(tmp_path: Path) -> None:
    bevel = [(0, 0, 0), (0, 8, -8)]
    plates = [
        prism([*bevel, (0, 100, -8), (0, 100, 0)], (150, 0, 0)),
        prism([*bevel, (0, 8, -80), (0, 0, -80)], (150, 0, 0)),
    ]
    write_step(assembly(*plates), tmp_path / "mitre.step")
    words = ["part", str(tmp_path / "mitre.step"), "--plan", "0", "--out", str(tmp_path / "out")]
    assert "is not listed and cannot be welded: weld its inside." in CliRunner().invoke(app, words).stdout
    shape = read_shape(tmp_path / "mitre.step")
    outside = next(edge.id for edge in shape.edges if np.abs(edge.points_P[:, 1:]).max() < 1e-9)
    with pytest.raises(InputError, match=r"opens 270 deg, .* cannot be welded: weld its inside\."):
        seam_of(shape, SeamSource(edges=(outside,)), "fillet")


def test_after_a_minute_the_other_seams_are_not_planned(step: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = read_shape(step)
    monkeypatch.setattr(new, "_refused", lambda *_: "")
    seams = ranked(shape, load_tool(WELDING).tool)
    for most, count in ((60.0, 2), (0.0, 1)):
        monkeypatch.setattr(new, "MOST_PLANNING_S", most)
        monkeypatch.setattr(new, "process_time", iter((0.0, 0.0, 1.0)).__next__)
        found = with_plans(shape, seams, 10, step, None, WELDING, lambda stage, share: None)
        assert [seam.planned for seam in found] == [True] * count + [False] * (2 - count)


def test_a_ring_that_the_arm_cannot_turn_around_is_halved(tmp_path: Path) -> None:
    """Both halves together cover a circle of 100 mm and overlap by 5 mm at either end."""
    pipe = less(cylinder((0, 0, 0), 100, 50), cylinder((0, 0, -1), 94, 60))
    write_step(assembly(box((-220, -220, -10), (440, 440, 10)), pipe), tmp_path / "pipe.step")
    path, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "pipe.step"))
    assert note.startswith("The ring 14 in two halves that overlap by 5 mm. As a whole: ")
    assert path.name == "cell.yaml"
    part = part_of(load_scenario(str(path)).workpiece)  # type: ignore[arg-type]
    assert seam_count(part) == 2
    covered = np.zeros(3600, dtype=int)
    for k in range(2):
        p = 1e3 * numbered(part, k).seam_P
        assert np.hypot(p[:, 0], p[:, 1]) == pytest.approx(100.0, abs=0.05)
        turn = np.unwrap(np.arctan2(p[:, 1], p[:, 0]))
        low, high = np.degrees([turn.min(), turn.max()])
        covered[np.arange(math.ceil(10 * low), math.floor(10 * high) + 1) % 3600] += 1
    assert covered.min() == 1
    assert np.radians(0.1 * (covered == 2).sum()) * 100.0 == pytest.approx(10.0, abs=1.5)


def test_an_end_below_zero_belongs_to_a_ring(tmp_path: Path) -> None:
    write_pipe(tmp_path / "pipe.step", 80)
    shape = read_shape(tmp_path / "pipe.step")
    outside = max(shape.joints, key=lambda joint: joint.length_m)
    ring = seam_of(shape, SeamSource(edges=outside.edges, start_m=0.25, end_m=-0.02), "fillet")
    assert ring.length_m == pytest.approx(2.0 * math.pi * 0.08 - 0.23, abs=1e-3)
    for edges, end in [(outside.edges, -0.6)]:
        with pytest.raises(InputError, match="end_mm is cut off its end: give 0 or more"):
            seam_of(shape, SeamSource(edges=edges, end_m=end), "fillet")


def test_a_part_without_seams_says_so(tmp_path: Path) -> None:
    write_step(box((0, 0, 0), (100, 60, 10)), tmp_path / "plate.step")
    text = CliRunner().invoke(app, ["part", str(tmp_path / "plate.step"), "--out", str(tmp_path / "out")]).stdout
    assert "No seams are listed: no two bodies meet" in text
    assert "Pick by number" not in text
    assert "Picture: " in text


def test_the_least_pipe_that_a_tool_can_weld_is_named(tmp_path: Path) -> None:
    tool = load_tool(WELDING).tool
    reasons = []
    for radius in (70, 75):
        write_pipe(tmp_path / f"{radius}.step", radius)
        shape = read_shape(tmp_path / f"{radius}.step")
        outside = max(shape.joints, key=lambda joint: joint.length_m)
        reasons.append(next(seam.reason for seam in ranked(shape, tool) if seam.joint is outside))
    assert reasons[1] == ""
    least = re.search(r"least pipe for this tool is (\d+) mm across", reasons[0])
    assert least is not None
    assert 140 <= int(least[1]) <= 150
    # The advice, followed literally.
    assert "The tool pipe fits: part --tool pipe, new --tool-file pipe." in reasons[0]
    advised = ["part", str(tmp_path / "70.step"), "--tool", "pipe", "--plan", "1", "--json", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, advised)
    first = json.loads(result.stdout.splitlines()[-1])["seams"][0]
    assert [first["type"], first["weldable"], first["planned"]] == ["pipe on plate", True, True]


def test_a_lap_of_thin_sheets_needs_the_small_ball(tmp_path: Path) -> None:
    write_step(assembly(box((0, 0, -3), (220, 120, 3)), box((10, 40, 0), (200, 70, 1.5))), tmp_path / "lap.step")
    joints = read_shape(tmp_path / "lap.step")
    (large,), (small,) = (ranked(joints, load_tool(tool_file(Path(name))).tool) for name in ("welding", "tip_1p5"))
    assert "A tip of radius 2.5 mm is too large" in large.reason
    assert small.reason == ""
    cell = tmp_path / "cell"
    made = ["new", str(cell), "--part", str(tmp_path / "lap.step"), "--tool-file", "tip_1p5"]
    result = CliRunner().invoke(app, made)
    assert result.exit_code == 0, result.output
    assert "radius_mm: 1.0" in (cell / "tool.yaml").read_text()


def test_the_numbers_in_the_picture_do_not_overlap(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ribs = [box((0, y, 0), (200, 3, 40)) for y in range(5, 200, 12)]
    write_step(assembly(box((0, 0, -5), (200, 200, 5)), *ribs), tmp_path / "ribs.step")
    figures: list[Figure] = []
    kept = Figure.savefig

    def save(self: Figure, *args: object, **kwargs: object) -> None:
        figures.append(self)
        kept(self, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(Figure, "savefig", save)
    edges_picture(read_shape(tmp_path / "ribs.step"))
    (figure,) = figures
    for axes in figure.axes:
        boxes = []
        for text in axes.texts:
            x, y, _ = proj3d.proj_transform(*text.get_position_3d(), axes.get_proj())
            px, py = axes.transData.transform((x, y))
            size = text.get_window_extent()
            boxes.append(Bbox.from_bounds(px - size.width / 2, py - size.height / 2, size.width, size.height))
        assert len(boxes) > 12
        assert not [1 for a, b in combinations(boxes, 2) if a.overlaps(b)]


def test_a_very_small_part_is_asked_whether_it_is_in_inches(tmp_path: Path) -> None:
    write_step(box((0, 0, 0), (10, 5, 3)), tmp_path / "small.step")
    text = CliRunner().invoke(app, ["part", str(tmp_path / "small.step"), "--out", str(tmp_path / "out")]).stdout
    assert "10.0 x 5.0 x 3.0 mm: its unit may be inch" in text
