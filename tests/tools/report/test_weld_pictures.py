"""The pictures of a weld: zero is marked where the measure passes it, and a weld that lacks something is still
drawn."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.axes import Axes
from pydrake.math import RigidTransform

from tests.welding.locate.lying import box as solid_box
from tests.welding.locate.lying import triangles
from weldcal.models.mesh import TriMesh
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES
from weldcal.systems.messages import SeamRecord
from weldcal.systems.runner import ProcessTime
from weldcal.systems.station import Truth
from weldcal.tools.report.plots_weld import (
    WeldTrace,
    along_the_weld,
    broken,
    part_in_scan,
    paths,
    weld_traces,
    zero_crossings,
)
from weldcal.tools.report.weld import WeldLog, WeldOutcome
from weldcal.tools.report.weld_record import burned_arcs, places
from weldcal.welding.passes.felt import WeldPass
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase

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


TICK_S = 0.008


def two_passes() -> tuple[WeldLog, tuple[SeamRecord, SeamRecord]]:
    """A seam of 60 mm at 8 mm/s, held in its middle, and a pass back from its end 20 s later; planned from 5 mm on."""
    ahead = SeamCurve.from_points(np.column_stack([np.linspace(0.0, 0.06, 61), np.zeros(61), np.zeros(61)]))
    back = SeamCurve.from_points(np.column_stack([np.linspace(0.06, 0.0, 61), np.zeros(61), np.full(61, 0.003)]))
    codes, s, on = [], [], []
    for held in (True, False):
        places = np.arange(0.0, 0.06, 0.008 * TICK_S)
        codes += [PHASE_CODES[Phase.TOUCH]] * 10 + [PHASE_CODES[Phase.TRACK]] * len(places)
        s += [np.nan] * 10 + places.tolist()
        on += [False] * 10 + [not (held and 0.02 < at < 0.03) for at in places]
    n = len(s) // 2
    time = TICK_S * np.arange(2 * n) + np.where(np.arange(2 * n) < n, 0.0, 20.0)
    x = np.nan_to_num(np.where(np.arange(2 * n) < n, s, 0.06 - np.array(s)))
    p_BW = np.column_stack([x, 0.0 * x, np.where(np.arange(2 * n) < n, 0.0, 0.003)])
    names = ("delta_n", "delta_axial", "omega", "n_d_dot_n_t", "e_t", "s_tip")
    log = WeldLog(
        time=time,
        telemetry={"phase": np.array(codes), "s_torch": np.array(s)} | dict.fromkeys(names, 0.001 + 0.0 * x),
        torch_on=np.array(on),
        p_BTip=p_BW,
        p_BRobot=p_BW,
        R_BT=np.broadcast_to(np.eye(3), (2 * n, 3, 3)),
        p_BW=p_BW,
        p_BTorch=p_BW,
        work=0.0 * x,
        travel=0.0 * x,
        deflection_T=p_BW,
        sigma_min=0.0 * x,
    )
    return log, (
        SeamRecord(seam=0, line=ahead, begins_m=0.005),
        SeamRecord(seam=0, weld_pass=1, line=back, begins_m=0.005, reverse=True),
    )


def test_places_are_those_of_the_whole_seam() -> None:
    log, records = two_passes()
    s, left, up = places(log, records, log.telemetry["phase"] != PHASE_CODES[Phase.TOUCH])
    moving = np.isfinite(s)
    assert moving.sum() == len(s) - 20
    assert s[moving] == pytest.approx(0.005 + log.p_BW[moving, 0], abs=1e-6)
    assert np.abs(np.concatenate([left[moving], up[moving]])).max() < 1e-6


def test_each_arc_of_the_log_says_how_it_ended() -> None:
    log, _ = two_passes()
    lit = log.time[np.flatnonzero(np.diff(log.torch_on.astype(int)) > 0) + 1]
    arcs = [ProcessTime(on_s=at + 0.016, start=f"a{k}", end=f"b{k}") for k, at in enumerate(lit)]
    arcs[0].held_by = "the terminal"
    run: Any = SimpleNamespace(arcs=arcs, phases=[("weld", 0.0, 0.0)], held=True, reason="It was stopped.")
    ended = [(arc["start"], arc["ended"]) for arc in burned_arcs(run, log, 2)]
    assert ended == [("a0", "held by an operator (the terminal)"), ("a1", "done"), ("a2", "It was stopped.")]
    run.phases = [("weld", 0.0, 0.0), ("retract", 1.0, 1.0), ("held", 2.0, 2.0)]
    assert burned_arcs(run, log, 2)[-1] == {"run": 2, "start": "a2", "end": "b2", "ended": "done"}


def test_each_pass_has_its_own_picture_without_lines_where_the_arc_was_off(monkeypatch: pytest.MonkeyPatch) -> None:
    log, records = two_passes()
    weld = WeldOutcome(log=log, true_seam=None, planned=None, error=None, plan_error=None)
    job = SimpleNamespace(planned_seam=lambda _: SimpleNamespace(records=records), servo_config=ServoConfig())
    welding = SimpleNamespace(later_passes=lambda: (WeldPass(vertical_m=0.003, reverse=True),))
    nothing = SimpleNamespace(truth=Truth(X_BC=None, X_BP=None, workpiece=None))
    cell: Any = SimpleNamespace(job=job, station=nothing, scenario=SimpleNamespace(welding=welding))
    traces = weld_traces(weld, cell, cast(Any, None))
    assert list(traces) == ["1", "1_pass_2"]
    for one in traces.values():
        assert (np.nanmin(one.s), np.nanmax(one.s)) == pytest.approx((0.005, 0.065), abs=1e-4)
        assert paths(one)
        assert along_the_weld(one)
    drawn: list[Any] = []
    plot = Axes.plot
    monkeypatch.setattr(
        Axes, "plot", lambda axes, *data, **more: (drawn.append((data, more)), plot(axes, *data, **more))[1]
    )
    paths(traces["1"])
    torch = next(data for data, more in drawn if more.get("label") == "torch, arc on")
    gap = np.isnan(torch[1])  # over x of the base, as the pictures are drawn
    assert gap[1:-1].any(), "a line has a gap where the arc was off"
    assert np.nanmax(np.abs(np.diff(torch[1]))) < 1.0, "mm: none goes from seam to seam"
