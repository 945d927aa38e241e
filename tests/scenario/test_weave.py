"""A weave that a scenario orders: the true torch makes it, the report measures it, and what the arm cannot do is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.scenario.wired_orders import swings
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.weld import true_seam
from weldcal.welding.record.process import path_error

# The arm and the part have the errors of the shipped scenario; of the scanner's, what a calibration leaves.
CELL = """
scanner: !RenderedScanner
  preset: phoxi_m
  width: 824
  height: 616
  mounting_translation_mm: 0.0
  mounting_rotation_deg: 0.0
  scale_error: 0.0
  gradient_error_per_m: [0.0, 0.0]
  warp_mm: 0.1
job: {{calibrate: false, X_BC: {{xyz_m: [0.65, 0.0, 0.95], rpy_deg: [180.0, 0.0, -90.0]}}}}
welding: {{speed_mm_s: 16.0, seam_length_mm: 80.0, weave: {weave}}}
"""
MM = 1e-3


@pytest.mark.parametrize(
    ("weave", "period_s"),
    [
        ("{shape: sine, amplitude_mm: 2.0, frequency_hz: 2.0}", 0.5),
        ("{shape: triangle, amplitude_mm: 2.0, frequency_hz: 1.25, dwell_s: [0.0, 0.1]}", 0.9),
        ("{shape: trapezoid, amplitude_mm: 1.5, frequency_hz: 1.0}", 1.0),
        ("{shape: crescent, amplitude_mm: 2.5, frequency_hz: 1.25, bow_mm: 1.0, plane_deg: 15.0}", 0.8),
    ],
)
def test_the_true_torch_weaves_as_ordered(weave: str, period_s: float, tmp_path: Path) -> None:
    scenario = load_scenario("straight_groove", CELL.format(weave=weave))
    order = scenario.welding.weave
    assert order is not None
    options = RunOptions(scenario="a test's own", out=tmp_path / "run", recording=False)
    result = run_scenario(scenario, options)
    found = result.summary()
    assert found["state"] == "done", found.get("reason")
    weld, truth = result.weld, true_seam(result.run.cell.station.truth)
    assert weld is not None
    assert truth is not None
    log = weld.log
    off = path_error(log.p_BTorch[log.torch_on], truth)
    t = log.time[log.torch_on] - log.time[log.torch_on][0]
    rows = t > 1.5 * period_s
    t, s = t[rows], off.s[rows]
    seen = swings(t, off.lateral[rows], off.height[rows], period_s, np.deg2rad(order.plane_deg))
    side, amplitude_mm, mean = seen.side, seen.amplitude_m / MM, seen.mean_m
    assert amplitude_mm == pytest.approx(order.amplitude_mm, rel=0.03)
    assert seen.period_s == pytest.approx(period_s, rel=0.01)
    # the mean path; the triangle rests on the right for a ninth of its time, with the torch at its amplitude
    if order.shape == "triangle":
        mean[0] += order.amplitude_mm * MM / 9.0
    assert np.hypot(*mean) < 0.05 * MM

    ordered, (measured,) = found["weave"]["ordered"], found["weave"]["measured"]  # type: ignore[index]
    assert (ordered["shape"], ordered["amplitude_mm"]) == (order.shape, pytest.approx(order.amplitude_mm))
    assert measured["amplitude_mm"] == pytest.approx(amplitude_mm, rel=0.01)
    assert measured["frequency_hz"] == pytest.approx(order.frequency_hz, rel=0.01)
    assert measured["mean_path_mm"] < 0.05
    if order.shape == "crescent":
        wave = (side - side.mean()) / np.ptp(side) * 2.0
        A = np.column_stack([wave**2, t, np.ones(len(t))])
        assert -np.linalg.lstsq(A, s, rcond=None)[0][0] == pytest.approx(order.bow_mm * MM, rel=0.15)  # type: ignore[operator]
        assert measured["bow_mm"] == pytest.approx(order.bow_mm, rel=0.15)
    # judged against the ordered weave, and as fast along the seam as ordered
    assert found["torch_mean_mm"] < 0.1  # type: ignore[operator]
    assert found["welded_mm"] == pytest.approx(80.0, abs=1.5)
    assert "Weave of seam 1, measured" in (tmp_path / "run" / "report.html").read_text()


def test_a_weave_that_the_arm_cannot_do_is_refused_before_any_motion() -> None:
    """The cell is not even built, and the frequency that the sentence names is accepted."""
    weave = "{{shape: {shape}, amplitude_mm: 3.0, frequency_hz: {hz}}}"
    for shape in ("sine", "triangle", "trapezoid", "crescent"):
        with pytest.raises(InputError, match="than tool and arm can do") as refusal:
            build_cell(load_scenario("straight_groove", CELL.format(weave=weave.format(shape=shape, hz=4.0))))
        assert str(refusal.value).count(". ") == 0, "one sentence"
        (named,) = re.findall(r"frequency_hz to ([\d.]+) at most", str(refusal.value))
        build_cell(load_scenario("straight_groove", CELL.format(weave=weave.format(shape=shape, hz=named))))
        more = float(named) + 0.02
        with pytest.raises(InputError, match="than tool and arm can do"):
            build_cell(load_scenario("straight_groove", CELL.format(weave=weave.format(shape=shape, hz=more))))


@pytest.mark.parametrize(
    ("weave", "said"),
    [
        ("{shape: zigzag}", "shape must be sine, triangle, trapezoid, crescent, not 'zigzag'"),
        ("{dwell_s: [0.1, 0.1, 0.1]}", "dwell_s must hold one number or two, not 3"),
        ("{amplitude_mm: 9.0}", "8 mm and 5 times a second at most"),
        ("{amplitud_mm: 2.0}", "the nearest one is 'amplitude_mm'"),
    ],
)
def test_an_invalid_order_is_refused_by_name(weave: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("straight_groove", CELL.format(weave=weave))


def test_a_dwell_is_one_number_or_two() -> None:
    for dwell, sides in (("0", (0.0, 0.0)), ("0.2", (0.2, 0.2)), ("[0.1, 0.3]", (0.1, 0.3))):
        order = load_scenario("straight_groove", CELL.format(weave=f"{{dwell_s: {dwell}}}")).welding.weave
        assert order is not None
        assert (order.weave().dwell_left_s, order.weave().dwell_right_s) == sides
