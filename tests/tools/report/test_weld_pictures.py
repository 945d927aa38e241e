"""The pictures of a weld: zero is marked where the measure passes it, and a weld that lacks something is still
drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from pydrake.math import RigidTransform

from tests.welding.locate.lying import box as solid_box
from tests.welding.locate.lying import triangles
from weldcal.models.mesh import TriMesh
from weldcal.tools.report.plots_weld import WeldTrace, along_the_weld, broken, part_in_scan, paths, zero_crossings

N = 120
S = np.linspace(-0.06, 0.2, N)


def trace() -> WeldTrace:
    """A weld along y that bends once; every number is made up."""
    path = np.column_stack([0.02 * np.sin(10.0 * S), S, 0.0 * S])
    return WeldTrace(
        s=S,
        torch_on=S > 0.0,
        felt=S < 0.15,
        tip=path,
        torch=path,
        robot=path + 0.002,
        planned=path[::4] + 0.001,
        true=path[::4],
        plan_error=(S[::4], 0.001 + 0.0 * S[::4], 0.0 * S[::4]),
        torch_error=(S, 1e-5 * np.sin(50.0 * S), 0.0 * S),
        delta_n=np.full(N, 0.002),
        delta_axial=np.full(N, 0.003),
        speed=np.full(N, 0.008),
        omega=0.1 * np.sin(20.0 * S),
        n_d_dot_n_t=np.cos(10.0 * S),
        weld_speed=0.008,
        delta_d=0.002,
        axial_d=0.003,
        omega_max=0.8,
    )


def test_the_part_in_the_scan_shows_what_agrees_and_what_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan of a web that leans by 10 mm over the drawn one, of the drawn base, and of nothing of its right end."""
    drawn: dict[str, int] = {}

    def counted(axes: Axes, *data: Any, **more: Any) -> Any:
        drawn[more["label"]] = len(data[0])
        return plot(axes, *data, **more)

    plot = Axes.plot
    monkeypatch.setattr(Axes, "plot", counted)
    base = solid_box((-0.1, 0.1), (-0.05, 0.05), (0.0, 0.01))
    mesh = TriMesh(*triangles([base]))
    x, y = np.meshgrid(np.arange(-0.1, 0.05, 0.001), np.arange(-0.05, 0.05, 0.001))
    top = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)])
    web = np.column_stack([np.linspace(-0.1, 0.04, 500), np.zeros(500), np.full(500, 0.02)])
    svg = part_in_scan(np.vstack([top, web]), mesh, RigidTransform())
    assert svg.startswith(b"<")
    shown, other = drawn["the scan shows the drawn surface"], drawn["the scan shows another thing"]
    assert shown / len(top) == pytest.approx(6000 / 15500, rel=0.35)
    assert other / shown == pytest.approx(500 / 15000, rel=0.3)
    # A quarter of the top, the whole underside and the sides are not in the scan: 0.64 of the area.
    hidden = (0.25 * 0.02 + 0.02 + 2 * 0.01 * 0.3) / (2 * 0.02 + 2 * 0.01 * 0.3)
    assert drawn["drawn, not in the scan"] / 6000 == pytest.approx(hidden, abs=0.06)


def test_zero_is_found_between_the_samples_and_not_across_a_gap() -> None:
    s = np.arange(6.0)
    value = np.array([1.0, -1.0, -2.0, np.nan, 3.0, 0.0])
    assert zero_crossings(s, value) == pytest.approx([0.5, 5.0])
    assert len(zero_crossings(s, np.ones(6))) == 0


def test_the_place_where_the_published_law_divides_by_zero_is_marked() -> None:
    through, clear = trace(), replace(trace(), n_d_dot_n_t=np.full(N, 0.9))
    assert zero_crossings(1e3 * S, through.n_d_dot_n_t) == pytest.approx([50.0 * np.pi], abs=0.1)
    # A cross is two strokes; text is drawn as paths, so the mark is what differs.
    assert along_the_weld(through) != along_the_weld(clear)
    assert along_the_weld(through) == along_the_weld(trace()), "the same weld makes the same bytes"


@pytest.mark.parametrize(
    "lacking",
    [
        {"planned": None, "plan_error": None},
        {"true": None, "torch_error": None, "plan_error": None},
        {"e_t": 1e-4 * S, "torch_error": None, "plan_error": None},
        {"torch_on": np.zeros(N, dtype=bool), "torch_error": None},
        {"n_d_dot_n_t": np.full(N, np.nan)},
        {"work": 0.01 * S, "travel": 0.1 * S, "windows": (0.02, 0.3), "axes": (1, 0)},
    ],
    ids=lambda lacking: next(iter(lacking)),
)
@pytest.mark.filterwarnings("error")
def test_a_weld_that_lacks_something_is_still_drawn(lacking: dict[str, object]) -> None:
    weld = replace(trace(), **lacking)  # type: ignore[arg-type]
    for picture in (paths(weld), along_the_weld(weld)):
        assert b"<svg" in picture[:1024]


def test_several_seams_are_lines_of_their_own() -> None:
    one = trace()
    legs = np.array([N])  # the first row of the second seam
    twice = {
        name: np.concatenate([value, value])
        for name in ("s", "torch_on", "felt", "tip", "torch", "robot", "delta_n", "delta_axial", "speed", "omega")
        for value in [getattr(one, name)]
    }
    for name in ("s", "tip", "torch", "robot"):
        twice[name] = broken(twice[name], legs)
    both = replace(one, **twice, n_d_dot_n_t=np.concatenate([one.n_d_dot_n_t] * 2))
    assert np.isnan(both.s).sum() == 1
    assert np.isfinite(one.s).all()
    assert paths(both)
    assert along_the_weld(both)
