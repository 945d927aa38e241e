"""What a tablet scenario YAML may say: the rig on the wrist, the tablet on the table, and how far both are from the drawing."""

import dataclasses as dc
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.errors import InputError
from weldcal.systems.drivers.simulated_ur import SimulatedUr
from weldcal.systems.scenario import ErrorConfig, PoseConfig
from weldcal.systems.scenario_numbers import check_numbers


@dc.dataclass
class WristRig:
    """Camera and pen as drawn, in the flange's frame, and by how much the real ones differ."""

    camera: PoseConfig = dc.field(default_factory=lambda: PoseConfig([0.075, 0.0, 0.030], [0.0, 0.0, 90.0]))
    camera_error: ErrorConfig = dc.field(default_factory=lambda: ErrorConfig(4.0, 2.0))
    width: int = 640
    height: int = 480
    focal_px: float = 617.7
    grey_noise: float = 2.0
    depth_scale: float = 0.985  # the depth camera reads this share of the truth
    depth_noise_mm: float = 0.8
    pen_tip_m: list[float] = dc.field(default_factory=lambda: [0.0, -0.022, 0.165])
    pen_error_mm: float = 3.0
    pen_radius_mm: float = 0.7
    pen_stiffness_N_per_m: float = 300.0


@dc.dataclass
class TabletOnTable:
    """The tablet as it is thought to lie (its first landmark, x to the right of the page, y down the page, z into it)."""

    pose: PoseConfig = dc.field(default_factory=lambda: PoseConfig([0.60, 0.045, 0.010], [180.0, 0.0, 0.0]))
    error: ErrorConfig = dc.field(default_factory=lambda: ErrorConfig(4.0, 1.5))
    columns: int = 3
    rows: int = 3
    across_mm: float = 60.0
    down_mm: float = 38.0
    ring_mm: float = 8.0
    margin_mm: float = 25.0
    px_per_mm: float = 5.256  # of the page: 267 pixels per inch at a display scale of 2
    touch_noise_px: float = 0.3
    touch_force_N: float = 0.02  # from here on the tablet feels the pen


@dc.dataclass
class TabletScenario:
    """One tablet cell."""

    description: str = ""
    arm: str = "ur10e"
    robot: SimulatedUr = dc.field(default_factory=SimulatedUr)
    home_deg: list[float] = dc.field(default_factory=lambda: [190.0, -120.0, 135.0, -105.0, -90.0, 90.0])
    rig: WristRig = dc.field(default_factory=WristRig)
    tablet: TabletOnTable = dc.field(default_factory=TabletOnTable)
    look_distance_mm: float = 300.0
    clearance_mm: float = 15.0
    descent_mm_s: float = 12.0
    deepest_mm: float = 12.0  # below where the tablet is thought to be: then the touch is given up
    turn_deg: float = 22.5  # of the hand from touch to touch
    tilt_deg: float = 12.0  # of the pen, to all sides in turn; 0: an upright pen
    maximum_time_s: float = 180.0


def landmarks_m(tablet: TabletOnTable) -> NDArray[np.float64]:
    """Landmarks (n, 2) m of the page from its first, row by row."""
    return 1e-3 * np.array(
        [[i * tablet.across_mm, j * tablet.down_mm] for j in range(tablet.rows) for i in range(tablet.columns)]
    )


def load_tablet_scenario(path: Path | None = None, overrides: str = "") -> TabletScenario:
    """The scenario of a YAML file (None: as it ships), `overrides` a second YAML text on top.

    Raises:
        InputError: no such file, an unknown key, a wrong type, or numbers that no cell can be built from.
    """
    if path is not None and not path.is_file():
        raise InputError(f"There is no tablet scenario '{path}'.")
    scenario = TabletScenario()
    for text in ("" if path is None else path.read_text(encoding="utf-8"), overrides):
        if text.strip():
            try:
                scenario = yaml_load_typed(schema=TabletScenario, data=text, defaults=scenario)
            except Exception as error:  # Drake's loader raises several kinds
                raise InputError(f"The tablet scenario cannot be read: {' '.join(str(error).split())}") from error
    check_numbers(scenario)
    if scenario.tablet.columns < 2 or scenario.tablet.rows < 2:
        raise InputError("The tablet needs at least two columns and two rows of landmarks.")
    if len(scenario.rig.pen_tip_m) != 3 or len(scenario.home_deg) != 6:
        raise InputError("rig.pen_tip_m has three numbers and home_deg six.")
    return scenario


def page_in_base(tablet: TabletOnTable) -> RigidTransform:
    """X_BT as it is thought."""
    return tablet.pose.pose()


def upright(turn_rad: float, lean_rad: tuple[float, float]) -> RigidTransform:
    """Orientation of a flange that points down, turned about the vertical and leaning to two sides."""
    return RigidTransform(RollPitchYaw(np.pi + lean_rad[0], lean_rad[1], turn_rad), [0.0, 0.0, 0.0])
