"""The record of a part: figures by stretches against welds computed by hand, limits, the order, and its files."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.report.plots_weld import arc_along_seam
from weldcal.tools.report.weld_record import PartRecord
from weldcal.welding.record.order import OrderLimits, WeldOrder, WeldOrderError
from weldcal.welding.record.process import WeldProcess
from weldcal.welding.record.weld_log import NAMES, WeldRecord, load_weld_log, weld_log_texts
from weldcal.welding.record.welded_seam import (
    RECORD_COLUMNS,
    ArcPiece,
    WeldedSeam,
    arc_pieces,
    seam_rows,
    touch_numbers,
    welded_seam,
    with_overlaps,
)

TICK_S = 0.008
MAG = WeldProcess("MAG", 150.0, 20.0)


def log(speeds: list[float], process: WeldProcess = MAG, **columns: list[float]) -> WeldRecord:
    """A log of one touch of 5 ticks and then one tick at each speed (m/s) with the torch on."""
    n, touch = len(speeds) + 5, [np.nan] * 5
    table = {name: np.full(n, np.nan) for name in NAMES if name != "phase"}
    table |= {"time_s": TICK_S * np.arange(n), "torch_on": np.r_[np.zeros(5), np.ones(n - 5)]}
    table |= {"torch_speed_m_s": np.r_[np.zeros(5), speeds], "e_t_m": np.zeros(n), "e_height_m": np.zeros(n)}
    table |= {name: np.r_[touch, values] for name, values in columns.items()}
    return WeldRecord(table, np.array(["TOUCH"] * 5 + ["TRACK"] * (n - 5)), process, {"scenario": "s", "seed": 1})


def only(record: WeldRecord) -> WeldedSeam:
    (found,) = (welded_seam(record, number, rows) for number, rows in seam_rows(record, [(0, 0)]))
    assert found is not None
    return found


# 20 mm at 10 mm/s and 10 mm at 5 mm/s: two seconds each.
TWO_SPEEDS = [0.010] * 250 + [0.005] * 251


def test_a_tacks_angle_is_taken_where_the_tip_is_lifted() -> None:
    """The tip is 59 mm ahead of the torch: over a tack at 80 mm the torch is at 21 mm."""
    mm = np.arange(101.0)
    angle = np.where(np.abs(mm + 59.0 - 80.0) < 10.0, 6.0, np.where(np.abs(mm - 80.0) < 10.0, 1.0, 0.0))
    columns = {"s_seam_m": 1e-3 * mm, "s_torch_m": 1e-3 * mm, "s_tip_m": 1e-3 * (mm + 59.0)}
    columns |= {"travel_angle_rad": np.radians(angle)}
    record = log([0.010] * 101, **{name: column.tolist() for name, column in columns.items()})
    tacks = [{"from_mm": 76.0, "to_mm": 84.0}, {"from_mm": 28.0, "to_mm": 36.0}]
    record.settings["ordered"] = [{"seam": 1, "pass": 1, "tacks": tacks}]
    late, early = only(record).tacks
    assert (late["travel_angle_deg"].least, late["travel_angle_deg"].most) == pytest.approx((0.0, 6.0))
    assert np.isnan(early["travel_angle_deg"].most), "the tip was lifted before the arc was lit"
    assert early["path_mm"].most == 0.0


def test_set_values_give_the_heat_of_each_stretch() -> None:
    found = only(log(TWO_SPEEDS))
    heat, speed = found.figures["heat_input_kJ_mm"], found.figures["speed_mm_s"]
    assert (found.welded_mm, found.arc_s) == pytest.approx((30.0, 4.0), rel=0.01)
    # 0.8 * 20 V * 150 A = 2400 W: 0.24 and 0.48 kJ/mm, and 9600 J over 30 mm
    assert (heat.least, heat.mean, heat.most) == pytest.approx((0.24, 0.32, 0.48), rel=0.01)
    assert (speed.least, speed.mean, speed.most) == pytest.approx((5.0, 7.5, 10.0), rel=0.01)
    assert found.arc_values == "set"


def test_measured_values_count_more_than_set_ones() -> None:
    amps = [100.0] * 250 + [300.0] * 251
    found = only(log(TWO_SPEEDS, current_A=amps, voltage_V=[25.0] * 501))
    heat, current = found.figures["heat_input_kJ_mm"], found.figures["current_A"]
    assert found.arc_values == "measured"
    assert (current.least, current.mean, current.most) == pytest.approx((100.0, 200.0, 300.0), rel=0.01)
    # 0.8 * 25 V * (100, 300) A: 2000 W at 10 mm/s and 6000 W at 5 mm/s; 16 kJ over 30 mm
    assert (heat.least, heat.mean, heat.most) == pytest.approx((0.2, 0.5333, 1.2), rel=0.01)


def test_what_the_schedule_sets_counts_before_the_process() -> None:
    found = only(log(TWO_SPEEDS, set_current_A=[100.0] * 501, set_voltage_V=[25.0] * 501))
    assert (found.arc_values, found.figures["current_A"].mean) == ("set", pytest.approx(100.0))
    # 0.8 * 25 V * 100 A: 2000 W at 10 mm/s
    assert found.figures["heat_input_kJ_mm"].least == pytest.approx(0.2, rel=0.01)
    measured = only(log(TWO_SPEEDS, set_current_A=[100.0] * 501, set_voltage_V=[25.0] * 501,
                        current_A=[110.0] * 501, voltage_V=[24.0] * 501))  # fmt: skip
    assert (measured.arc_values, measured.figures["current_A"].mean) == ("measured", pytest.approx(110.0))


def test_the_record_states_where_the_arc_burned() -> None:
    pause = log([0.010] * 351, s_torch_m=(1e-5 * 8 * np.arange(351)).tolist())
    pause.columns["torch_on"][105:255] = 0.0  # 12 mm, from 8 mm on
    pieces = arc_pieces(pause, [(0, 0)])
    found = only(pause).joined(pieces)
    assert np.array(found.arc_mm) == pytest.approx(np.array([[0.0, 8.0], [20.0, 28.0]]), abs=0.1)
    assert found.welded_mm == pytest.approx(16.0, abs=0.2)


def test_a_log_without_an_arc_has_no_piece() -> None:
    dark = log([0.010] * 100, s_torch_m=(1e-4 * np.arange(100)).tolist())
    dark.columns["torch_on"][:] = 0.0
    assert arc_pieces(dark, [(0, 0)]) == []


def test_what_is_welded_twice_counts_once() -> None:
    """A run from 0 to 40 mm, one that was lost from 32 to 60 mm, and one backwards from 100 to 52 mm."""
    first, last = (
        log([0.010] * len(mm), s_seam_m=(1e-3 * mm).tolist()) for mm in (np.arange(41.0), 100.0 - np.arange(49.0))
    )
    first.settings["arcs"] = [{"run": 1, "ended": "killed"}]
    last.settings["arcs"] = [{"run": 3, "start": "a", "end": "b"}]
    joined = last.after(first)
    lost = ArcPiece(seam=1, weld_pass=1, run=2, from_mm=32.0, to_mm=60.0, ended="killed")
    pieces = with_overlaps(sorted([lost, *arc_pieces(joined, [(0, 0), (0, 0)])], key=lambda piece: piece.run))
    assert [(p.run, *np.round((p.from_mm, p.to_mm, p.overlap_mm), 6)) for p in pieces] == [
        (1, 0.0, 40.0, 0.0), (2, 32.0, 60.0, 8.0), (3, 100.0, 52.0, 8.0)
    ]  # fmt: skip
    assert [(p.start, p.ended) for p in pieces] == [("", "killed"), ("", "killed"), ("a", "done")]
    seam = welded_seam(joined, (0, 0), np.ones(len(joined), dtype=bool))
    assert seam is not None
    assert seam.joined(pieces).welded_mm == pytest.approx(100.0)
    record = PartRecord(order=WeldOrder(), log=joined, seams=(), plots={}, pieces=pieces)
    assert record.broke_off == [
        "Seam 1: the arc broke off at 40 mm in run 1 (killed); run 2 went on at 32 mm, 8 mm over the weld.",
        "Seam 1: the arc broke off at 60 mm in run 2 (killed); run 3 went on at 100 mm, 8 mm over the weld.",
    ]


def test_an_arc_that_goes_out_by_itself_ends_a_piece() -> None:
    arc = [0.0] * 5 + [1.0] * 45 + [0.0] * 50 + [1.0] * 51  # lit after 40 ms, out for 0.4 s
    record = log([0.010] * 151, arc=arc, s_seam_m=(1e-3 * np.arange(151.0)).tolist())
    record.settings["arcs"] = [{"run": 1, "ended": "held"}]
    pieces = arc_pieces(record, [(0, 0)])
    assert [(p.from_mm, p.to_mm, p.ended) for p in pieces] == [
        (5.0, 49.0, "the power source reported no arc"), (100.0, 150.0, "held")
    ]  # fmt: skip
    record.columns["arc"][60:110] = 1.0
    record.columns["arc"][70:75] = 0.0  # 40 ms: a contact bounces
    assert len(arc_pieces(record, [(0, 0)])) == 1


def test_a_hold_of_the_touch_begins_no_other_weld() -> None:
    phase = np.array(["TOUCH", "HELD", "TOUCH", "TRACK", "HELD", "BACK", "TRACK", "TOUCH", "TRACK"])
    held = np.isin(phase, ("HELD", "BACK"))
    assert touch_numbers(phase == "TOUCH", held).tolist() == [0, 0, 0, 0, 0, 0, 0, 1, 1]


def test_without_arc_values_no_heat_is_stated() -> None:
    found = only(log(TWO_SPEEDS, WeldProcess()))
    assert found.arc_values == "unknown"
    assert np.isnan(found.figures["heat_input_kJ_mm"].mean)
    assert found.outside(OrderLimits(heat_input_kJ_mm=[0.1, 9.0])) == ("heat_input_kJ_mm",)
    assert found.outside(OrderLimits(speed_mm_s=[1.0, 20.0])) == ()


def test_the_time_before_the_arc_is_no_time_of_welding() -> None:
    waiting = only(log([0.0] * 100 + [0.010] * 251, arc=[0.0] * 100 + [1.0] * 251))
    assert (waiting.arc_s, waiting.welded_mm) == pytest.approx((2.0, 20.0), rel=0.01)
    standing = only(log([0.0] * 100 + [0.010] * 251))
    # 0.8 s of standing with the arc on: 1.8 s for the first 10 mm
    assert standing.figures["speed_mm_s"].least == pytest.approx(10.0 / 1.8, rel=0.01)


def test_ordered_standing_is_no_travel_and_longer_standing_is() -> None:
    stands = log([0.0] * 100 + [0.010] * 251 + [0.0] * 50)
    found = only(replace(stands, settings={"start_s": 0.8, "crater_s": 0.4}))
    assert (found.arc_s, found.welded_mm) == pytest.approx((3.2, 20.0), rel=0.01)
    assert found.figures["speed_mm_s"].least == pytest.approx(10.0, rel=0.01)
    shorter = only(replace(stands, settings={"start_s": 0.3, "crater_s": 0.4}))
    assert shorter.figures["speed_mm_s"].least == pytest.approx(10.0 / 1.5, rel=0.01)


def test_a_hold_is_no_time_of_welding() -> None:
    record = log([0.010] * 251)
    record["time_s"][100:] += 30.0
    assert only(record).arc_s == pytest.approx(2.0, rel=0.01)


def test_pieces_of_a_pass_share_a_row() -> None:
    one = log([0.010] * 251)
    table = {name: np.concatenate([one[name]] * 4) for name in one.columns}
    table["time_s"] = TICK_S * np.arange(len(table["time_s"]))
    record = WeldRecord(table, np.concatenate([one.phase] * 4), MAG)
    found = {number: rows.sum() for number, rows in seam_rows(record, [(0, 0), (0, 0), (0, 1), (4, 0)])}
    assert found == {(0, 0): 2 * len(one), (0, 1): len(one), (4, 0): len(one)}


def test_an_arc_that_never_burned_has_no_row() -> None:
    record = log([0.010] * 20, arc=[0.0] * 20)
    assert welded_seam(record, (0, 0), np.ones(len(record), dtype=bool)) is None


@pytest.mark.parametrize(
    ("limits", "outside"),
    [
        ({"heat_input_kJ_mm": [0.2, 0.5], "speed_mm_s": [4.9, 10.1], "current_A": [150.0, 160.0]}, ()),
        ({"heat_input_kJ_mm": [0.25, 0.5]}, ("heat_input_kJ_mm",)),
        ({"speed_mm_s": [4.9, 9.9]}, ("speed_mm_s",)),
        ({"voltage_V": [21.0, 25.0], "path_mm": 0.29}, ("voltage_V", "path_mm")),
        ({"path_mm": 0.31}, ()),
    ],
)
def test_each_limit_is_compared_with_the_extremes(limits: dict[str, object], outside: tuple[str, ...]) -> None:
    off = [1e-4] * 500 + [3e-4]
    assert only(log(TWO_SPEEDS, e_t_m=off)).outside(OrderLimits(**limits)) == outside  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ("{part: 4711}", "order.part' is a text: write '4711' in quotes"),
        ("{batch: 2026-11-27}", "order.batch' is a text: write '2026-11-27' in quotes"),
        ("{wbs: a}", "the nearest one is 'wps'"),
        (f"{{note: {'x' * 201}}}", "one line of at most 200 characters"),
        ("{limits: {speed_mm_s: 9}}", r"speed_mm_s' is a list: write \[9, ...\]"),
        ("{limits: {speed_mm_s: [9, 7]}}", "the least and the largest value"),
        ("{limits: {heat_input_kJ_mm: [1, 2, 3]}}", "the least and the largest value"),
        ("{limits: {path_mm: 0}}", "path_mm must be a positive number"),
    ],
)
def test_an_order_that_cannot_be_is_refused(order: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("s_groove", f"welding: {{order: {order}}}")


@pytest.mark.parametrize(
    ("limit", "process", "said"),
    [
        ("heat_input_kJ_mm: [0.1, 2]", "", "needs the arc's current and voltage"),
        ("current_A: [100, 200]", "", "needs the arc's current and voltage"),
        ("current_A: [100, 200]", "current_A: 150, voltage_V: 20, efficiency: 0.8", ""),
        ("heat_input_kJ_mm: [0.1, 2]", "name: MAG, current_A: 150, voltage_V: 20", ""),
    ],
)
def test_a_limit_of_what_nobody_knows_is_refused_before_the_weld(limit: str, process: str, said: str) -> None:
    keys = f"welding: {{order: {{limits: {{{limit}}}}}, process: {{{process}}}}}"
    if said:
        with pytest.raises(InputError, match=said):
            load_scenario("s_groove", keys)
    else:
        assert load_scenario("s_groove", keys).welding.order.limits != OrderLimits()


def test_heat_by_a_power_source_needs_the_process() -> None:
    order = "{power_source: !SimulatedPowerSource {}, welding: {order: {limits: {heat_input_kJ_mm: [0.1, 2]}}PROCESS}}"
    with pytest.raises(InputError, match=r"write welding\.process\.name"):
        load_scenario("s_groove", order.replace("PROCESS", ""))
    assert load_scenario("s_groove", order.replace("PROCESS", ", process: {name: MAG}")).welding.process.name == "MAG"


def test_a_line_break_in_an_order_is_refused() -> None:
    with pytest.raises(WeldOrderError, match="one line"):
        WeldOrder(note="a\nb").check()


def test_the_files_of_a_record_hold_order_figures_and_pictures(tmp_path: Path) -> None:
    order = WeldOrder(wps="WPS-12", part="0711", limits=OrderLimits(speed_mm_s=[6.0, 11.0]))
    record = log(TWO_SPEEDS)
    plot = arc_along_seam(record, record.torch_on, order.limits)
    assert plot is not None
    PartRecord(order=order, log=record, seams=(only(record),), plots={(1, 1): plot}).write(tmp_path)
    page = (tmp_path / "record.html").read_text()
    assert "Record of the weld of part 0711" in page
    assert "Part 0711, operator not named: fail, 1 of the limits not met; 1 seam welded" in page
    assert page.count('<svg class="plot') == 1
    assert not re.search(r'(src|href)="(?!data:|#)', page), "it needs no other file"
    with (tmp_path / "record.csv").open(newline="") as table:
        (row,) = csv.DictReader(table)
    assert (row["wps"], row["part"], row["seam"], row["arc_values"]) == ("WPS-12", "0711", "1", "set")
    assert (row["within_limits"], row["outside"], row["speed_mm_s_from"]) == ("no", "speed_mm_s", "6.0")
    assert float(row["heat_input_kJ_mm_mean"]) == pytest.approx(0.32, rel=0.01)
    document = json.loads((tmp_path / "record.json").read_text())
    assert document["order"] == {"wps": "WPS-12", "part": "0711", "limits": {"speed_mm_s": [6.0, 11.0]}}
    assert document["seams"][0]["figures"]["speed_mm_s"]["least"] == pytest.approx(5.0, rel=0.01)
    assert re.fullmatch(
        r"Seam 1: travel speed is 5\.0[0-4]\d to 10\.0[0-4]\d mm/s, and the limit is 6 to 11\.",
        *document["outside_limits"],
    )


def test_every_column_of_the_record_is_in_the_document(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "weld_log_columns.md").read_text()
    named = set(re.findall(r"`([A-Za-z_]+)`", page.partition("## The columns of a record")[2]))
    like_heat = {
        name.replace("heat_input_kJ_mm", other) for name in named for other in ("speed_mm_s", "current_A", "voltage_V")
    }
    assert set(RECORD_COLUMNS) <= named | like_heat


def test_a_log_of_before_is_read_without_the_later_columns(tmp_path: Path) -> None:
    table, header = weld_log_texts(log([0.010] * 20))
    rows = [line.rsplit(",", 11)[0] for line in table.splitlines()]
    assert rows[0].endswith("sigma_min")
    old = "\n".join(rows) + "\n"
    (tmp_path / "weld.csv").write_text(old)
    document = json.loads(header) | {"sha256": hashlib.sha256(old.encode()).hexdigest()}
    (tmp_path / "weld.json").write_text(json.dumps(document))
    found = load_weld_log(tmp_path)
    assert np.isnan(found["current_A"]).all()
    assert (found.arc == found.torch_on).all()
