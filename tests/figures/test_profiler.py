"""The study's own worlds, of other seeds than the fixed files: the joint methods are at their bound, the papers' are
not."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from tests.figures.harness import Missed, Run
from tests.figures.profiler import reproduce
from tests.figures.profiler.papers import SPHERE_METHODS, edge_rows, measure
from tests.figures.profiler.reproduce import compute, figure_text, fixed_lines
from tests.worlds.edge_trials import made_edge_trials
from tests.worlds.profiler import SphereWorld, WorldData, groove_mesh, scan_groove, sphere_trial
from weldcal.models.errors import InputError


def test_on_other_edges_the_joint_method_is_near_its_bound_and_the_papers_is_not() -> None:
    rows = edge_rows("tilt_paper", made_edge_trials("tilt_paper", 4, 7), lambda _: None, (25,))
    last = {r.method: r for r in rows}
    # rms of four errors of at least one degree of freedom: sigma sqrt(1/8) = 0.35 of the bound
    assert last["joint"].translation_mm < (1 + 3 * 0.35) * last["joint"].crb_mm
    assert last["paper"].translation_mm > 1.3 * last["joint"].translation_mm
    # the published criterion does not tell them apart
    assert last["paper"].d_mean_mm == pytest.approx(last["joint"].d_mean_mm, rel=0.1)


def test_in_another_world_touches_help_the_paper_and_the_joint_method_needs_no_sides() -> None:
    world = SphereWorld.made(40)
    results = {r.method: r for r in measure(0, WorldData(sphere_trial(world, 40), scan_groove(world, 40)))}
    points = [results[m].points_mm.mean() for m in SPHERE_METHODS]
    assert points[1] < 0.5 * points[0]
    assert points[2] < 0.5 * points[1]
    assert points[3] < 0.15
    seam = results[SPHERE_METHODS[3]].seam_mm
    assert seam is not None
    assert seam.max() < 0.3


def test_the_groove_is_as_wide_and_deep_as_drawn() -> None:
    low, high = np.min(groove_mesh().vertices, axis=0), np.max(groove_mesh().vertices, axis=0)
    assert (low[2], high[2]) == pytest.approx((-0.060, 0.0))


def test_what_the_fixed_files_hold_besides_both_papers_tables_is_met(shared_data: Path) -> None:
    lines = fixed_lines(shared_data / "profiler", lambda _, __: None)
    assert len(lines) == 34
    assert [line for line in lines if not line[2] <= line[3]] == []


def test_a_fixed_file_that_is_missing_is_named_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "edge_features.npz").touch()
    with pytest.raises(InputError, match=r"There is no edge_sphere\.npz"):
        compute(tmp_path, 0, False, lambda _, __: None)
    assert [path.name for path in tmp_path.iterdir()] == ["edge_features.npz"]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(0.0, "of 12", "0 of 12"), (3.0, "points", "3 points"), (0.1234, "mm", "0.123 mm"), (2.6e-13, "deg", "2.6e-13 deg"), (5.918, "", "5.918")],
)  # fmt: skip
def test_a_figure_is_told_with_its_unit(value: float, unit: str, text: str) -> None:
    assert figure_text(value, unit) == text


def test_everything_random_follows_from_the_seed() -> None:
    one, two, other = (sphere_trial(SphereWorld.made(s), s, touches=8, views=1) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.data.profiles[5], two.data.profiles[5])
    assert not np.allclose(one.data.profiles[5], other.data.profiles[5])


@pytest.mark.parametrize("data", [None, Path("fixed")])
def test_targets_of_the_fixed_files_do_not_decide_on_other_worlds(
    monkeypatch: pytest.MonkeyPatch, data: Path | None
) -> None:
    missed = reproduce.Target("frustum, length", "mm", 0.053, 0.042)
    monkeypatch.setattr(reproduce, "compute", lambda *_: ([missed], [], []))
    monkeypatch.setattr(reproduce, "_sphere_tables", lambda results: [])
    run = Run(data=data)
    with nullcontext() if data is None else pytest.raises(Missed, match="1 targets"):
        reproduce.profiler(run)
    assert "MISSED" in run.text[0]
