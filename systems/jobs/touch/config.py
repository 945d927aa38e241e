"""Configuration of the touch job: the calibration to judge, the places and the motion."""

import dataclasses as dc
from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import FingerCameraConfig, NoDevice
from weldcal.systems.scenario.schema import FILE, Scenario

FEWEST, MOST = 3, 60
_POSITIVE = ("aside_mm", "clearance_mm", "descent_mm_s", "press_mm", "deepest_mm")


@dc.dataclass(kw_only=True)
class TouchConfig:
    """`touch:` places on the part beside its groove, and how the tip goes down to them."""

    # a result of calibrate or demo: its folder, or calibration.yaml
    result: str = dc.field(default="", metadata=FILE)
    points: int = 8  # along the seam, on both sides in turn
    aside_mm: float = 9.0  # of the groove's middle, where the face is flat
    clearance_mm: float = 20.0  # of the tip above the face, where the descent begins; the torch hangs as low as the tip
    descent_mm_s: float = 3.0
    press_mm: float = 1.0  # deflection of the tip at which it has touched
    deepest_mm: float = 5.0  # below the scanned face, where the touch is abandoned
    turn_deg: float = 20.0  # of the tool to either side, from touch to touch


def check_touch(scenario: Scenario) -> None:
    """Check the touch job of a scenario; a scenario without one passes.

    Raises:
        InputError: one sentence that says what to change.
    """
    touch = scenario.part(TouchConfig)
    if touch is None:
        return
    if scenario.job.calibrate or scenario.job.weld:
        raise InputError(
            "The touch job neither calibrates nor welds: write job: {calibrate: false, weld: false}, or run it with weldcal verify RESULT "
            "--scenario NAME."
        )
    if not touch.result or not Path(touch.result).exists():
        raise InputError(f"touch.result must be a result of weldcal calibrate, and there is none at '{touch.result}'.")
    if not scenario.welds or scenario.workpiece is None or not isinstance(scenario.finger_camera, FingerCameraConfig):
        raise InputError("A touch needs a tool with a soft tip, a finger_camera and a workpiece in the scenario.")
    if isinstance(scenario.scanner, NoDevice):
        raise InputError("A touch needs the scanner that was calibrated: write scanner: in the scenario.")
    for name in _POSITIVE:
        if not getattr(touch, name) > 0.0:
            raise InputError(f"touch.{name} must be a positive number, not {getattr(touch, name):g}.")
    if not FEWEST <= touch.points <= MOST:
        raise InputError(f"touch.points must be from {FEWEST} to {MOST}, not {touch.points}.")
    if not 0.0 <= touch.turn_deg <= 45.0:
        raise InputError(f"touch.turn_deg must be from 0 to 45, and it is {touch.turn_deg:g}.")
