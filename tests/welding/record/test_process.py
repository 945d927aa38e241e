"""The process: heat per length is k U I / v, nothing is stated that was not given; speed and angles of the torch."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from weldcal.models.errors import InputError
from weldcal.systems.recording.scenario_files import packed, unpacked
from weldcal.systems.scenario.loading import load_scenario
from weldcal.welding.record.process import (
    EFFICIENCY,
    PathError,
    ProcessLogError,
    WeldProcess,
    path_error,
    speed_along,
    wire_angles,
)
from weldcal.welding.seam.curve import SeamCurve


@pytest.mark.parametrize(("name", "k"), [("MAG", 0.8), ("TIG", 0.6), ("SAW", 1.0)])
def test_heat_input_is_the_processes_share_of_power_over_speed(name: str, k: float) -> None:
    arc = WeldProcess(name, current_A=200.0, voltage_V=25.0)
    # 5000 W at 8 mm/s are 0.625 kJ/mm of arc energy.
    assert arc.heat_input([0.008, 0.004]) == pytest.approx([k * 0.625e6, k * 1.25e6])
    assert arc.missing is None


def test_an_efficiency_that_is_given_counts_more_than_the_processes_own() -> None:
    assert WeldProcess("TIG", 100.0, 10.0, efficiency=0.5).heat_input(0.001) == pytest.approx(0.5e6)
    assert WeldProcess(None, 100.0, 10.0, efficiency=0.5).k == 0.5


def test_a_torch_at_rest_heats_without_bound_and_an_arc_that_is_off_not_at_all() -> None:
    heat = WeldProcess("MAG", 200.0, 25.0).heat_input([0.0, math.nan])
    assert heat[0] == math.inf
    assert math.isnan(heat[1])


@pytest.mark.parametrize("arc", [WeldProcess(), WeldProcess("MAG")])
def test_without_current_and_voltage_no_heat_is_invented(arc: WeldProcess) -> None:
    assert np.isnan(arc.heat_input([0.008, 0.004])).all()
    assert "no heat input" in str(arc.missing)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"name": "glue"}, "one of MAG"),
        ({"name": "MAG", "current_A": 200.0}, "both current_A and voltage_V"),
        ({"current_A": 200.0, "voltage_V": 25.0}, "name or its efficiency"),
        ({"name": "MAG", "current_A": -200.0, "voltage_V": 25.0}, "current_A must be a positive number"),
        ({"name": "MAG", "wire_feed_m_min": math.nan}, "wire_feed_m_min must be a positive number"),
        ({"name": "MAG", "efficiency": 1.2}, "at most 1"),
    ],
)
def test_a_process_that_cannot_be_is_refused_in_one_sentence(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said) as refusal:
        WeldProcess(**wrong)  # type: ignore[arg-type]
    assert str(refusal.value).endswith(".")


def test_a_scenario_says_what_the_power_source_is_set_to() -> None:
    text = "welding: {process: {name: TIG, current_A: 90.0, voltage_V: 11.0, wire_feed_m_min: 1.5}}"
    arc = load_scenario("s_groove", text).welding.process
    assert (arc.name, arc.current_A, arc.voltage_V, arc.k, arc.wire_feed_m_min) == ("TIG", 90.0, 11.0, 0.6, 1.5)
    assert load_scenario("s_groove").welding.process == WeldProcess(), "the shipped scenario knows of no arc"
    with pytest.raises(InputError, match="both current_A"):
        load_scenario("s_groove", "welding: {process: {name: TIG, current_A: 90.0}}")


def test_every_efficiency_is_a_share() -> None:
    assert all(0.0 < k <= 1.0 for k in EFFICIENCY.values())


def test_the_speed_along_an_arc_is_its_chord_over_the_window() -> None:
    t = np.arange(0.0, 2.0, 0.008)
    p = 0.06 * np.column_stack([np.cos(0.13 * t), np.sin(0.13 * t), 0.0 * t])
    # A chord of 50 ms on this circle is shorter than its arc by less than 1e-5; interpolating within a tick adds less.
    assert speed_along(t, p) == pytest.approx(np.full(len(t), 0.06 * 0.13), rel=1e-5)
    jumpy = p + np.random.default_rng(0).normal(0.0, 1e-6, p.shape)
    # Noise of two points over 50 ms and not over 8: 0.16 of it, and twice that in the half windows of the ends.
    assert np.std(speed_along(t, jumpy)) < 0.2 * np.std(np.linalg.norm(np.diff(jumpy, axis=0), axis=1) / 0.008)


@pytest.mark.parametrize("time", [[0.0], [0.0, 0.0], [0.0, 1.0, 2.0]])
def test_a_speed_needs_two_points_and_a_time_that_rises(time: list[float]) -> None:
    with pytest.raises(ProcessLogError):
        speed_along(time, np.zeros((len(time) if len(time) < 3 else 2, 3)))


def test_a_wire_that_leans_shows_it_in_the_angle_of_that_direction() -> None:
    # about the direction of travel, about the left, and a wire that leans back in a tool that is level
    R = np.array([RollPitchYaw(*rpy).ToRotationMatrix().matrix() for rpy in ((0.10, 0, 0), (0, -0.20, 0), (0, 0, 0))])
    frame = [np.tile(axis, (3, 1)) for axis in np.eye(3)]
    work, travel = wire_angles(R, *frame)
    assert work == pytest.approx([0.10, 0.0, 0.0])
    assert travel == pytest.approx([0.0, 0.20, 0.0])  # the tip is higher, and the wire points forward: push
    assert wire_angles(R[2:], *[axis[2:] for axis in frame], tilt_rad=0.3)[1] == pytest.approx([0.3])


def test_the_ends_of_a_weld_are_measured_apart_from_its_middle() -> None:
    """A torch 0.04 mm beside a straight seam of 100 mm, but for four bumps whose places and heights are known."""
    x = np.arange(3.0, 98.0, 0.25)
    y, z = np.full(len(x), 0.04), np.zeros(len(x))
    for place, aside, up in ((7.75, 0.3, 0.4), (8.25, 0.0, 0.2), (92.75, -0.25, 0.0), (93.0, 0.05, 0.12)):
        y[x == place], z[x == place] = aside, up
    seam = SeamCurve.from_points(np.outer(np.linspace(0.0, 0.1, 11), [1.0, 0.0, 0.0]))
    found = path_error(1e-3 * np.column_stack([x, y, z]), seam)
    # The weld is from 3.0 to 97.75 mm: its ends reach to 8.0 and from 92.75 on.
    assert 1e3 * np.array(found.ends_m()) == pytest.approx([0.5, 0.25, 0.2], abs=1e-6)
    assert 1e3 * found.distance_m.max() == pytest.approx(0.5, abs=1e-6)


def test_a_weld_shorter_than_its_two_ends_has_no_middle() -> None:
    found = PathError(np.array([0.0, 4e-3, 8e-3]), np.array([1e-4, 3e-4, 2e-4]), np.zeros(3)).ends_m()
    assert found[:2] == pytest.approx((3e-4, 3e-4))
    assert math.isnan(found[2])


@pytest.mark.parametrize(
    ("arc", "said"),
    [
        ("{start: soon}", "rest or moving"),
        ("{crater_s: 11.0}", "crater_s must be from 0 to 10"),
        ("{start_s: -1.0}", "start_s must be from 0 to 10"),
        ("{start_s: 0.5}", "write welding.arc.start: rest"),
    ],
)
def test_an_arc_that_cannot_start_so_is_refused(arc: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("s_groove", f"welding: {{arc: {arc}}}")


def test_a_reported_arc_starts_at_rest_and_that_of_an_old_recording_does_not(tmp_path: Path) -> None:
    wired = load_scenario("wired_straight_groove")
    assert wired.welding.arc.from_rest(wired.robot.reports_arc)
    files = packed(wired)
    assert unpacked(files, tmp_path).welding.arc.start is None
    text = files["scenario.yaml"].decode()
    old = re.sub(r"^  arc:.*\n(?:    .*\n)*", "", text, flags=re.MULTILINE)
    assert old != text
    before = unpacked({"scenario.yaml": old.encode()}, tmp_path)
    assert not before.welding.arc.from_rest(before.robot.reports_arc)
