"""A broken weld of stitches and of several seams goes on with the piece and the seam that broke off."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pydrake.math import RigidTransform

from tests.systems.jobs.test_arm_way import planning
from weldcal.systems.jobs.weld import progress_keeper
from weldcal.systems.jobs.weld.arm_way import leaning
from weldcal.systems.jobs.weld.progress_keeper import ProgressKeeper
from weldcal.systems.jobs.weld.seam_planning import gone_on, stitch_piece
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import PlannedSeam, SeamRecord
from weldcal.welding.record.progress import PROGRESS_NAME, Progress, load_progress
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.plan_fit import PlanFit
from weldcal.welding.seam.restart import NoRoomBehindCrater, Restart
from weldcal.welding.servo.state import WeldingState

SEAM = SeamCurve.from_points(np.column_stack([np.linspace(0.0, 0.2, 41), np.zeros(41), np.zeros(41)]))
STITCHES = "welding: {stitch: {on_mm: 40, off_mm: 40, order: middle_out}}"  # 80 to 120, then 0 to 40, 160 to 200


@pytest.mark.parametrize(("piece", "begins_mm", "ends_mm"), [(0, 80.0, 120.0), (1, 17.0, 40.0), (2, 160.0, 200.0)])
def test_only_the_broken_stitch_begins_before_its_crater(piece: int, begins_mm: float, ends_mm: float) -> None:
    restart = Restart(seam=0, piece=1, p_BCrater=np.array([0.025, 1e-4, 0.0]), p_BBegin=np.array([0.0005, 0.0, 0.0]))
    order = replace(planning(STITCHES), piece=piece, restart=restart)
    order, line, _, _ = stitch_piece(order, SEAM, SeamRecord(seam=0))
    order, line, down_m, again = gone_on(order, line, SEAM, None, 0.0, None)
    assert 1e3 * again["begins_m"] == pytest.approx(begins_mm, abs=0.01)
    assert 1e3 * line.position(line.length)[0] == pytest.approx(ends_mm, abs=0.01)
    assert 1e3 * line.position(0.0)[0] == pytest.approx(begins_mm, abs=0.01)
    assert ("question" in again, down_m is not None) == (piece == 1, piece == 1)


TACKS = "welding: {{tacks: [{{from_mm: 20, to_mm: 26, height_mm: 5.5}}, {{from_mm: {0}, to_mm: {1}, height_mm: 5.5}}]}}"


def test_a_tack_stays_where_it_is_when_the_weld_goes_on() -> None:
    crater = Restart(seam=0, p_BCrater=np.array([0.025, 1e-4, 0.0]), p_BBegin=np.array([0.0005, 0.0, 0.0]))
    order, _, down_m, again = gone_on(
        replace(planning(TACKS.format(150, 160)), restart=crater), SEAM, SEAM, None, 0.0, None
    )
    assert again["begins_m"] == pytest.approx(0.017, abs=1e-5)
    assert down_m is not None
    (tack,) = order.config.tacks
    assert (tack.start, tack.end) == pytest.approx((0.133, 0.143), abs=1e-5), "the first one lies behind the tip"
    begun = leaning(planning(TACKS.format(150, 160)).config, 0.0, down_m, begins_m=again["begins_m"])
    assert begun.tacks == order.config.tacks, "the servo lifts the tip where it was planned"
    with pytest.raises(NoRoomBehindCrater, match="weld it by hand"):
        gone_on(replace(planning(TACKS.format(62, 70)), restart=crater), SEAM, SEAM, None, 0.0, None)


def test_the_crater_stays_where_the_first_run_located_it() -> None:
    """A new scan places the seam's start 2 mm further back."""
    again = replace(planning(), restart=Restart(seam=0, p_BCrater=np.array([0.1, 0.0, 0.0]), crater_m=0.098))
    _, _, _, found = gone_on(again, SEAM, SEAM, None, 0.0, None)
    assert found["begins_m"] == pytest.approx(0.090, abs=1e-5)
    assert "8 mm before the crater at 98 mm" in found["question"]


class Weld:
    """A weld of seams in the order 1, 0, whose torch moves along x; as a keeper looks at it."""

    def __init__(self, folder: Path, begun: Progress) -> None:
        self.folder, self.keeper, self.seconds = folder, ProgressKeeper(folder, {"a": b"1"}, begun), 0.0
        self.look(0, 0, phase="approach_above")

    def look(self, seam: int, piece: int, x: float = 0.0, phase: str = "weld", done: bool = False, **more: Any) -> None:
        self.seconds += 0.008
        key = (1, seam, piece)
        state = WeldingState(plan_fit=PlanFit.start(SEAM), s_torch=x, arc_seen=True)
        report = ServoReport(
            phase="DONE" if done else "TRACK",
            torch_on=not done,
            state=state,
            X_BT=RigidTransform([x, 0.0, 0.0]),
            plan_key=key,
        )
        planned = PlannedSeam(sequence=1, number=seam, piece=piece, seam=SEAM, **more)
        job = SimpleNamespace(
            command=lambda _: SimpleNamespace(phase=phase),
            servo_report=lambda _: report,
            planned_seam=lambda _: planned,
            travel=SimpleNamespace(order=(1, 0)),
            passes=1,
        )
        cell = SimpleNamespace(job=job, scenario=None, station=None)
        command = SimpleNamespace(seam=seam, piece=piece, weld_pass=0)
        run = SimpleNamespace(cell=cell, root=None, command=command, seconds=self.seconds, interrupted=None)
        self.keeper.look(cast(Any, run))

    def weld(self, seam: int, piece: int, to_m: float, **more: Any) -> None:
        for x in np.arange(0.0, to_m + 1e-9, 64e-6):
            self.look(seam, piece, float(x), **more)


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Weld:
    monkeypatch.setattr(progress_keeper, "seam_tool", lambda *_: SimpleNamespace(p_TW=np.zeros(3)))
    made = Progress(scenario="", seed=0, robot=None, scenario_sha256="", ends=("",), seam=1)
    return Weld(tmp_path, made)


def test_the_next_piece_and_the_next_seam_of_the_order_stand_in_the_file(begun: Weld) -> None:
    found = []
    for seam, piece, more in ((1, 0, True), (1, 1, False), (0, 0, False)):
        begun.weld(seam, piece, 0.003, more=more)
        begun.look(seam, piece, 0.003, done=True, more=more)
        now = begun.keeper.progress
        found.append((now.seam, now.piece, now.done, now.p_BCrater, now.p_BBegin))
    begun.keeper.close()
    assert found[:2] == [(1, 1, False, None, None), (0, 0, False, None, None)]
    assert found[2][2], "nothing is left"
    assert load_progress(begun.folder).done
    assert [(one.seam, one.piece, one.done) for one in load_progress(begun.folder).stretches] == [
        (1, 0, True),
        (1, 1, True),
        (0, 0, True),
    ]


def test_a_kill_loses_no_more_than_the_newest_line(begun: Weld, monkeypatch: pytest.MonkeyPatch) -> None:
    begun.weld(1, 0, 0.0004)
    while not (begun.folder / PROGRESS_NAME).exists():
        time.sleep(0.005)
    monkeypatch.setattr(Progress, "write", lambda *_: None)  # the disk is slow: no progress any more
    begun.weld(1, 0, 0.005)
    begun.keeper.close()
    found = load_progress(begun.folder).restart(8e-3)
    assert found.p_BCrater is not None
    assert found.p_BCrater[0] == pytest.approx(0.005, abs=0.2e-3)
