"""Without ur_rtde (Python 3.13) a robot is refused before any work, and the pre-flight and a dry run still work."""

from __future__ import annotations

import sys

import pytest

from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.drivers.ur.errors import RobotRefused
from weldcal.systems.drivers.ur.readiness.releases import require_ur_rtde
from weldcal.systems.drivers.ur.rtde import PrepareRobot, UrRtde
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands import robots


@pytest.fixture(autouse=True)
def absent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hides ur_rtde from this test."""
    for name in ("rtde_control", "rtde_receive"):
        monkeypatch.setitem(sys.modules, name, None)


def test_the_sentence_says_what_to_install() -> None:
    with pytest.raises(RobotRefused, match=r"ur-rtde.*not installed.*Python 3\.12\.$"):
        require_ur_rtde()


def test_the_driver_asks_nothing_of_the_robot_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("weldcal.systems.drivers.ur.rtde.preflight", lambda *_, **__: pytest.fail("it was asked"))
    with pytest.raises(RobotRefused, match="ur-rtde"):
        PrepareRobot(UrRtde(host="127.0.0.1"), load_arm())


@pytest.mark.parametrize("word", ["emulated", "127.0.0.9"])
def test_a_run_is_refused_before_an_emulator_starts(monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    monkeypatch.setattr(robots, "emulator_process", lambda **_: pytest.fail("the emulator was started"))
    with pytest.raises(RobotRefused, match="ur-rtde"), robots.chosen_robot(word, load_scenario("s_groove")):
        pytest.fail("the run began")


def test_a_simulated_arm_and_a_dry_run_need_none_of_it() -> None:
    scenario = load_scenario("s_groove")
    with robots.chosen_robot("simulated", scenario) as robot:
        assert robot.title == "simulated"
    # A dry run gets as far as looking at the controller, which is not there.
    with pytest.raises(RobotRefused, match=r"127\.0\.0\.9"), robots.chosen_robot("127.0.0.9", scenario, dry_run=True):
        pytest.fail("nothing answers there")
