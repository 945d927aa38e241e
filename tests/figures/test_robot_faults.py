"""The study of faults of the robot link: a wrong result fails it."""

from __future__ import annotations

from tests.figures.robot.faults import wrong_ones
from tests.worlds.robot.cases import STOP
from tests.worlds.robot.fault_run import FaultOutcome


def test_a_wrong_result_fails_the_study_and_is_named() -> None:
    wrong = FaultOutcome(
        name="nothing", must=STOP, did="stopped", fault="", sentence="", problems=("not at rest within 0.3 s",)
    )
    assert wrong_ones([wrong], []) == {"nothing": "not at rest within 0.3 s"}
