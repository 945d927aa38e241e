"""`weldcal part`: the table, the JSON and the pictures of a part's edges."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.worlds.parts.step_parts import PARTS, assembly, box, cylinder, less, prism, write_step
from weldcal.models.errors import InputError
from weldcal.models.tools.loading import WELDING, load_tool, tool_file
from weldcal.models.workpieces.part import numbered, seam_count
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.models.workpieces.shape import PartJoint
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import part_of
from weldcal.systems.scenario.schema import PoseConfig, Scenario
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell import new
from weldcal.tools.commands.cell.new import OwnPart, planned, write_cell
from weldcal.tools.commands.cell.part import with_plans
from weldcal.tools.commands.cell.screen import Seam, followed, ranked, unfit, ways


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
    assert len((tmp_path / "edges.csv").read_text().splitlines()) == 25
    page = (tmp_path / "seams.html").read_text()
    assert found["report"] == str(tmp_path / "seams.html")
    assert "http" not in page.replace("http-equiv", "")  # one file, no network
    scene = scene_of(tmp_path)
    assert len(scene["triangles"]) == 24
    assert [seam["edges"] for seam in scene["seams"]] == [row["edges"] for row in found["seams"]]
    assert {seam["state"] for seam in scene["seams"]} == {"fits"}  # the arm was not asked: no line to copy
    assert {seam["text"] for seam in scene["seams"]} == {""}
    ends = {tuple(point) for seam in scene["seams"] for line in seam["lines"] for point in line}
    assert len(ends) == 4
    assert {abs(x) for x, _, _ in ends} == {90.0}


def scene_of(folder: Path) -> dict[str, Any]:
    """What seams.html draws."""
    text = re.search(r"const \{ vertices, triangles, seams \} = (.*);", (folder / "seams.html").read_text())
    assert text is not None
    return dict(json.loads(text[1]))


def test_only_verbose_lists_the_edges_joints_first(step: Path, tmp_path: Path) -> None:
    words = ["part", str(step), "--plan", "0", "--out", str(tmp_path / "out")]
    assert "convex" not in CliRunner().invoke(app, words).stdout
    result = CliRunner().invoke(app, [*words, "-v", "--overwrite"])
    assert result.stdout.startswith("part: the tool fits 2 seams")
    rows = [line.split() for line in result.stdout.partition("start -> end, mm\n")[2].splitlines()]
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
    assert "pipe on plate, 502.7 mm, 90 deg. Fits the tool, not planned" in " ".join(text.split())
    assert f"weldcal part {tmp_path / 'pipe.step'}" in text  # the next step asks the arm


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


LINES = re.compile(r"^  seams: .*\n  joint: .*$", re.MULTILINE)
"""The lines of cell.yaml over which those of the page are pasted."""


def ordered(cell: str) -> str:
    """The two lines of a cell.yaml that name its seams, without their comments."""
    (found,) = LINES.findall(cell)
    return "\n".join(line.split("  #")[0] for line in found.splitlines())


def a_post(folder: Path) -> tuple[Path, PartJoint]:
    """A post on a plate, and the one joint around it: four edges."""
    path = folder / "p.step"
    write_step(assembly(box((-150, -150, -10), (300, 300, 10)), box((-50, -35, 0), (100, 70, 40))), path)
    (joint,) = read_shape(path).joints
    return path, joint


def answers(monkeypatch: pytest.MonkeyPatch, poses: list[set[int]]) -> None:
    """Let the arm weld in each pose of the part only some edges, each alone."""

    def places(scenario: Scenario, apart: bool = False, advises: bool = False, until_s: float = 0.0) -> object:
        asked = scenario.workpiece.seams  # type: ignore[union-attr]
        alone = {seam.edges[0]: k for k, seam in enumerate(asked) if len(seam.edges) == 1}
        found = [
            (PoseConfig([0.65, 0.0, z], [0.0] * 3), [alone[id] for id in alone if id in some])
            for z, some in enumerate(poses)
        ]
        welded = {k for _, some in found for k in some}
        if not apart and len(welded) < len(asked):
            return [], dict.fromkeys(range(len(asked)), "Too near.")
        return [at for at in found if at[1]], {k: f"Wall {k}." for k in range(len(asked)) if k not in welded}

    monkeypatch.setattr(new, "weldable_places", places)
    monkeypatch.setattr(new, "add_scan_poses", lambda scenario, path: "")


def test_an_edge_that_is_refused_is_named_and_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, joint = a_post(tmp_path)
    blocked, *rest = joint.edges
    answers(monkeypatch, [set(rest)])
    for given in ((), joint.edges):
        path, note = write_cell(tmp_path / f"cell{len(given)}", "s_groove", OwnPart(file, given))
        seams = load_scenario(str(path)).workpiece.seams  # type: ignore[union-attr]
        assert [seam.edges for seam in seams] == [[id] for id in rest]
        assert note == f"Without edge {blocked}: Wall 0."
        assert f"# {note}" in path.read_text()


def test_sides_of_a_post_in_two_poses_are_two_offers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, joint = a_post(tmp_path)
    a, b, c, d = joint.edges
    answers(monkeypatch, [{a, b}, {c}])
    ((offers, refused),) = planned(OwnPart(file), [joint.edges], WELDING, lambda stage, share: None)
    assert [offer.edges for offer in offers] == [[a, b], [c]]
    assert [offer.pose.xyz_m[2] for offer in offers] == [0.0, 1.0]
    assert refused == {d: "Wall 3."}
    assert offers[0].note == f"Without edge {c}: in another pose of the part. Without edge {d}: Wall 3."
    # What `new` makes of each offer's edges is the offer.
    for offer in offers:
        cell, _ = write_cell(tmp_path / str(offer.edges[0]), "s_groove", OwnPart(file, tuple(offer.edges)))
        assert ordered(cell.read_text()) == offer.lines


def test_a_refusal_names_each_edge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, joint = a_post(tmp_path)
    answers(monkeypatch, [set()])
    path, reason = write_cell(tmp_path / "cell", "s_groove", OwnPart(file))
    assert path.name == "unfinished.yaml"
    assert [f"Edge {id}: Wall {k}." in reason for k, id in enumerate(joint.edges)] == [True] * 4


def test_edges_that_do_not_follow_are_several_seams(tmp_path: Path) -> None:
    file, joint = a_post(tmp_path)
    a, b, c, d = joint.edges
    assert followed(read_shape(file), [a, b, d]) == [[d, a, b]] or followed(read_shape(file), [a, c]) == [[a], [c]]
    with pytest.raises(InputError, match="has no edge 999"):
        followed(read_shape(file), [a, 999])


def test_the_edge_below_a_tube_is_left_out(tmp_path: Path) -> None:
    """Two tubes end to end: of the butt around them the arm reaches all but the edge that lies on the table."""
    tubes = [less(box((x, 0, 0), (100, 40, 40)), box((x - 1, 3, 3), (102, 34, 34))) for x in (0, 101)]
    write_step(assembly(*tubes), tmp_path / "tubes.step")
    shape = read_shape(tmp_path / "tubes.step")
    ring = max(shape.joints, key=lambda joint: joint.length_m)
    (below,) = (id for id in ring.edges if np.abs(shape.edge(id).points_P[:, 2]).max() < 1e-6)
    _, (pieces, _, apart) = ways(shape, ring.edges)
    assert apart
    assert [seam.edges for seam in pieces] == [[id] for id in ring.edges if id != below]
    assert unfit(shape.edge(below)) == "open downwards as drawn, where no arm reaches."


def gusset() -> Any:
    return assembly(box((-150, -100, -10), (300, 200, 10)), box((-70, -4, 0), (140, 8, 70)))


def channel() -> Any:
    """A U-channel, open below, with a cap at its end: seven edges around it, of which an arm reaches few."""
    bent = less(box((0, 0, 0), (200, 80, 60)), box((-1, 8, -1), (202, 64, 53)))
    return assembly(bent, box((200, -20, 0), (10, 120, 100)))


MADE = {
    "gusset": gusset,
    "channel": channel,
    "tube": lambda: assembly(
        box((-150, -150, -10), (300, 300, 10)), less(cylinder((0, 0, 0), 84, 50), cylinder((0, 0, -1), 76, 60))
    ),
    "lap": lambda: assembly(box((0, 0, -6), (220, 120, 6)), box((10, 40, 0), (200, 70, 6))),
    "butt": lambda: assembly(box((0, 0, -6), (220, 60, 6)), box((0, 61.5, -6), (220, 60, 6))),
    "two solids": lambda: PARTS["two_solids"]().shape,
}


@pytest.mark.parametrize("name", MADE)
def test_the_printed_command_and_the_copied_lines_work(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = f"{name}.step"
    write_step(MADE[name](), tmp_path / file)
    printed = CliRunner().invoke(app, ["part", file, "--plan", "1", "--out", "out"])
    assert printed.exit_code == 0, printed.output
    assert len(printed.stdout.splitlines()) <= 12
    shown = [seam for seam in scene_of(tmp_path / "out")["seams"] if seam["state"] == "yes"]
    (command,) = re.findall(r"weldcal new .*", printed.stdout)
    assert command == shown[0]["command"]
    made = CliRunner().invoke(app, shlex.split(command)[1:])
    assert made.exit_code == 0, made.output
    cell = Path("my_cell/cell.yaml")
    text = cell.read_text()
    assert ordered(text) == shown[0]["text"]  # `new` welds exactly what is offered
    for seam in shown:
        cell.write_text(LINES.sub(seam["text"], text))
        spec = load_scenario(str(cell)).workpiece
        assert spec is not None
        assert {id for one in spec.seams for id in one.edges} == set(seam["edges"])
        assert seam_count(part_of(spec)) >= len(spec.seams)
    if name == "gusset":
        _, one, _, other = read_shape(tmp_path / file).joints[0].edges
        assert sorted(shown[0]["edges"]) == sorted((one, other))
        assert re.search(r"seams: \[\{edges: \[\d+\]\}, \{edges: \[\d+\]\}\]", shown[0]["text"])


def test_bodies_have_the_names_of_the_file(step: Path, tmp_path: Path) -> None:
    text = step.read_text()
    for k, name in ((1, "base plate"), (2, "web")):
        text = re.sub(rf"'Open CASCADE STEP translator [\d.]+ \d+\.{k}'", f"'{name}'", text)
    (tmp_path / "named.step").write_text(text)
    assert {joint.bodies for joint in read_shape(step).joints} == {()}
    assert {joint.bodies for joint in read_shape(tmp_path / "named.step").joints} == {("base plate", "web")}
    words = ["part", str(tmp_path / "named.step"), "--plan", "0", "--out", str(tmp_path / "out")]
    printed = " ".join(CliRunner().invoke(app, words).stdout.split())
    assert "(+y): T left of base plate and web, 180.0 mm" in printed


def test_the_outside_of_a_mitre_is_refused_with_what_to_do(tmp_path: Path) -> None:
    bevel = [(0, 0, 0), (0, 8, -8)]
    plates = [
        prism([*bevel, (0, 100, -8), (0, 100, 0)], (150, 0, 0)),
        prism([*bevel, (0, 8, -80), (0, 0, -80)], (150, 0, 0)),
    ]
    write_step(assembly(*plates), tmp_path / "mitre.step")
    words = ["part", str(tmp_path / "mitre.step"), "--plan", "0", "--out", str(tmp_path / "out")]
    shown = " ".join(CliRunner().invoke(app, words).stdout.split())
    assert "is not listed and cannot be welded: weld its inside." in shown
    shape = read_shape(tmp_path / "mitre.step")
    outside = next(edge.id for edge in shape.edges if np.abs(edge.points_P[:, 1:]).max() < 1e-9)
    with pytest.raises(InputError, match=r"opens 270 deg, .* cannot be welded: weld its inside\."):
        seam_of(shape, SeamSource(edges=(outside,)), "fillet")


def test_seams_are_ranked_as_a_welder_would(tmp_path: Path) -> None:
    """A long thick rib, a short one, a thin sheet, a strip that is too low to weld, and last a bolt by its name."""
    bodies = {
        "base": box((0, 0, -10), (600, 400, 10)),
        "M10 bolt": cylinder((500, 350, 0), 60, 30),
        "rib": box((50, 60, 0), (150, 10, 40)),
        "long rib": box((50, 200, 0), (300, 10, 40)),
        "sheet": box((50, 330, 0), (350, 1.5, 40)),
        "strip": box((50, 370, 0), (350, 10, 0.5)),
    }
    write_step(assembly(*bodies.values()), tmp_path / "a.step")
    text = (tmp_path / "a.step").read_text()
    for k, name in enumerate(bodies):
        text = re.sub(rf"'Open CASCADE STEP translator [\d.]+ \d+\.{k + 1}'", f"'{name}'", text)
    (tmp_path / "a.step").write_text(text)
    seams = ranked(read_shape(tmp_path / "a.step"), load_tool(WELDING).tool)
    order = list(dict.fromkeys(seam.joint.bodies[1] for seam in seams))
    assert order[:2] == ["long rib", "rib"]
    assert seams[-1].joint.bodies[1] == "M10 bolt"
    assert not seams[-1].reason
    assert seams[-2].reason
    assert [round(1e3 * v) for v in seams[0].joint.thick_m] == [10, 10]


def test_of_a_ring_of_edges_those_that_the_tool_fits_are_offered(tmp_path: Path) -> None:
    """A square post with a wall beside one of its four sides."""
    post, wall = box((0, 0, 0), (160, 160, 80)), box((-40, -100, 0), (10, 360, 120))
    write_step(assembly(box((-150, -150, -10), (500, 460, 10)), post, wall), tmp_path / "post.step")
    shape = read_shape(tmp_path / "post.step")
    around = {e.id for e in shape.edges if e.points_P.min() > -1e-6 and e.points_P.max() < 0.16 + 1e-6}
    seam = next(s for s in ranked(shape, load_tool(WELDING).tool) if set(s.joint.edges) <= around)
    assert (seam.reason, len(seam.refused)) == ("", 1)
    (id,) = seam.refused
    assert shape.edge(id).points_P[:, 0] == pytest.approx(0.0)
    assert "The tool does not fit" in seam.refused[id]


def test_equal_seams_are_one_line(tmp_path: Path) -> None:
    plates = [box((0, 0, -10), (700, 200, 10)), *(box((60 + 180 * k, 20, 0), (10, 150, 40)) for k in range(4))]
    write_step(assembly(*plates), tmp_path / "ribs.step")
    words = ["part", str(tmp_path / "ribs.step"), "--plan", "0", "--out", str(tmp_path / "out")]
    printed = " ".join(CliRunner().invoke(app, words).stdout.split())
    assert "the tool fits 4 seams" in printed
    assert re.search(r"seam 1 .* 3 like it: edge", printed)
    result = CliRunner().invoke(app, [*words, "--json", "--overwrite"])
    likes = [seam["like"] for seam in json.loads(result.stdout.splitlines()[-1])["seams"]]
    assert likes == [1, 1, 1, 1]


def test_after_its_time_the_other_seams_are_not_planned(step: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = read_shape(step)
    seams = ranked(shape, load_tool(WELDING).tool)
    for count in (2, 1):
        answers = iter([([], {1: "Too near."})] * count)

        def offered(*_: object, answers: Iterator[object] = answers, **__: object) -> object:
            if (answer := next(answers, None)) is None:
                raise new.OutOfTimeError
            return answer

        monkeypatch.setattr(new, "offered", offered)
        found = with_plans(shape, seams, 10, step, None, WELDING, lambda stage, share: None)
        assert sorted(seam.planned for seam in found) == [False] * (2 - count) + [True] * count


def test_no_place_is_looked_for_after_the_time(step: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is that of the command with the process that reads the part."""
    monkeypatch.setattr(new, "MOST_PART_S", 0.0)
    seams = ranked(read_shape(step), load_tool(WELDING).tool)
    found = with_plans(read_shape(step), seams, 10, step, None, WELDING, lambda stage, share: None)
    assert not any(seam.planned for seam in found)


def test_a_ring_that_the_arm_cannot_turn_around_is_halved(tmp_path: Path) -> None:
    """Both halves together cover a circle of 100 mm and overlap by 5 mm at either end."""
    pipe = less(cylinder((0, 0, 0), 100, 50), cylinder((0, 0, -1), 94, 60))
    write_step(assembly(box((-220, -220, -10), (440, 440, 10)), pipe), tmp_path / "pipe.step")
    path, note = write_cell(tmp_path / "cell", "s_groove", OwnPart(tmp_path / "pipe.step"))
    assert note == "The ring 14 in two halves that overlap by 5 mm."
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
    assert "no seams: no two bodies meet" in text
    assert "weldcal new" not in text
    assert "seams.html" in text


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


def test_a_very_small_part_is_asked_whether_it_is_in_inches(tmp_path: Path) -> None:
    write_step(box((0, 0, 0), (10, 5, 3)), tmp_path / "small.step")
    text = CliRunner().invoke(app, ["part", str(tmp_path / "small.step"), "--out", str(tmp_path / "out")]).stdout
    assert "10.0 x 5.0 x 3.0 mm: its unit may be inch" in text
