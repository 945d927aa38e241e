"""The calls of weldcal whose results hold while its structure changes: commands on measured data, cases and scenarios.

Words in braces are replaced: {data} and {cases} are the shared folders, {models} the project's models,
{made} made inputs, {out} the result of the call itself; any other name is the result folder of the call of that name.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye import rendering
from tests.places import ROOT, SHARED_DATA

CASES = SHARED_DATA.parent / "cases"

_FLANGE = '--flange "ISO 9409-1-50-4-M6"'
_WRIST = "--mounting eye_in_hand"
RECORDED = {
    "calibrate_aubo": "calibrate {data}/flange/aubo_i5_phoxi_s",
    "calibrate_compare": "calibrate {data}/flange/ur10e_phoxi_m --compare",
    "calibrate_franka": "calibrate {data}/flange/franka_phoxi_m --axis-turn 30",
    "calibrate_azure": "calibrate {data}/flange/ur10e_azure_kinect",
    "calibrate_local": "calibrate {data}/flange/aubo_i5_phoxi_s --refine local --limit-mm 0.5",
    "calibrate_kuka": "calibrate {cases}/inputs/p01_kuka_dat_E6POS/scans " + _FLANGE,
    "calibrate_rapid": "calibrate {cases}/inputs/p04_abb_rapid/scans " + _FLANGE,
    "calibrate_ply": "calibrate {cases}/inputs/c07_ply_list_in_vertex/scans " + _FLANGE,
    "verify_scans": "verify {calibrate_aubo} {data}/flange/aubo_i5_phoxi_s",
    "verify_pairs": "verify {hand_eye_moveit} {data}/handeye/moveit_calibration/pairs.npz",
    "apply": "apply {calibrate_aubo} {data}/flange/aubo_i5_phoxi_s/clouds/{cloud} {out}.ply",
    "doctor": "doctor {calibrate_azure}",
    "import": "import {cases}/inputs/p01_kuka_dat_E6POS/scans " + _FLANGE,
    "fleet": "fleet {made}/cells --workers 1",
    "hand_eye_moveit": "hand-eye ax-yb {data}/handeye/moveit_calibration/pairs.npz",
    "hand_eye_static": "hand-eye ax-yb {data}/handeye/ros_industrial_charuco_static_camera/pairs.npz --mounting eye_on_base",
    "hand_eye_grid": "hand-eye ax-yb {data}/handeye/ros_industrial_circle_grid_camera_on_wrist/pairs.npz " + _WRIST,
    "hand_eye_kuka": "hand-eye ax-yb {data}/handeye/RWHE_Calib_kuka_1/pairs.npz " + _WRIST,
    "hand_eye_visp": "hand-eye ax-yb {data}/handeye/visp_franka_eye_in_hand/pairs.npz " + _WRIST,
    "hand_eye_workcell": "hand-eye ax-yb {data}/handeye/multi_camera_workcell_camera1/pairs.npz --mounting eye_on_base",
    "hand_eye_scara": "hand-eye ax-yb {data}/handeye/handeye_4dof/pairs.npz " + _WRIST,
    "hand_eye_outlier": "hand-eye ax-xb {data}/handeye/handeye_calib_camodocal/pairs.npz " + _WRIST,
    "hand_eye_streams": "hand-eye ax-yb {data}/handeye/ethz_asl_robot_arm_real/streams.npz " + _WRIST,
    "hand_eye_pictures": "hand-eye ax-yb {made}/pictures --board chessboard:9x6:25 " + _WRIST,
    "hand_eye_joints": "hand-eye ax-yb {cases}/inputs/j3b_refine_joints/pairs.npz --robot ur10e --refine joints "
    + _WRIST,
    "two_robots": "hand-eye axb-ycz {made}/two_robots.npz",
    "profiler_edge": "profiler edge {data}/profiler/edge_features.npz --as set=free40_nominal --as trial=0 --unit mm",
    "profiler_edge_paper": "profiler edge {data}/profiler/edge_features.npz --as set=grid_tilt_paper --as trial=0 --method paper --unit mm",
    "profiler_sphere": "profiler sphere {data}/profiler/sphere.npz --as trial=0 --unit mm",
    "profiler_export": "profiler sphere {cases}/inputs/v05_table_quaternion/table.csv --radius 20 --unit mm",
    "profiler_compensate": "profiler compensate {data}/profiler/sphere.npz --as trial=0 --unit mm",
    "profiler_seam": "profiler seam {data}/profiler/groove.npz --as trial=0 --unit mm --calibration {profiler_sphere}",
    "tablet_calibrate": "tablet calibrate {data}/profiler/tablet_published.npz --two-stages",
    "part": "part {cases}/parts/12_pipe_80_on_plate/own_pipe_on_plate.step --plan 0",
    "plan_poses": "plan-poses calibrate_only --scans 12",
    "plan_passes": "plan-passes straight_groove --wire-feed-m-min 8",
    "tool_check": "tool check {models}/tools/welding.yaml",
    "robots": "robots ur10e",
}
"""What needs no live run, by name."""

LIVE = {
    "demo": "demo s_groove --no-browser",
    "weld_straight": "weld straight_groove --no-browser",
    "weld_corner": "weld l_groove --no-browser",
    "weld_bent": "weld curved_s_groove --no-browser",
    "demo_carried": "demo carried_scanner --no-browser",
    "live_bare_flange": "calibrate --scenario calibrate_only",
    "live_motion": "calibrate --scenario motion",
    "live_eye_on_base": "demo eye_on_base --no-browser",
    "live_eye_in_hand": "demo eye_in_hand --no-browser",
    "live_eye_on_arm": "demo eye_on_arm --no-browser",
    "live_co_manipulation": "demo co_manipulation --no-browser",
    "live_profiler": "profiler live profiler_edge",
    "live_seam": "profiler live profiler_seam",
    "live_tablet": "tablet demo",
}
"""A scenario each, in simulation, with seed 1."""

CALLS = {**RECORDED, **LIVE}


def named(command: str) -> tuple[str, ...]:
    """The calls whose result folders a command reads."""
    return tuple(word for word in re.findall(r"\{(\w+)\}", command) if word in CALLS)


def filled(name: str, results: Path, made: Path) -> str:
    """The command of a call with the folders in place of the words in braces."""
    places = {
        "data": SHARED_DATA,
        "cases": CASES,
        "models": ROOT / "models",
        "out": results / name,
        "made": made,
        "cloud": min(path.name for path in (SHARED_DATA / "flange" / "aubo_i5_phoxi_s" / "clouds").iterdir()),
        **{other: results / other for other in CALLS},
    }
    return CALLS[name].format_map(places)


def make_inputs(made: Path) -> None:
    """Write the inputs that nobody measured: pairs of two robots, a folder of cells, and pictures."""
    made.mkdir(parents=True, exist_ok=True)
    np.savez(made / "two_robots.npz", **_two_robots())
    cells = made / "cells"
    cells.mkdir(exist_ok=True)
    for name in ("ur10e_phoxi_m", "ur10e_azure_kinect"):
        shutil.copytree(SHARED_DATA / "flange" / name, cells / name, dirs_exist_ok=True)
    if not (made / "pictures").exists():
        drawing = rendering.draw_chessboard(9, 6, 25)
        world = rendering.world(drawing, 5, 12)
        rendering.write_pictures(made / "pictures", drawing, world, 5, sub=2)
        rendering.write_robot(made / "pictures" / "poses.txt", world.robot)


def _two_robots() -> dict[str, object]:
    """Pairs with A X B = Y C Z, 0.1 mm and 0.01 degrees of noise in B."""
    rng = np.random.default_rng(4)

    def pose(turn: float = 0.6) -> np.ndarray:
        X = np.eye(4)
        X[:3, :3] = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix()
        X[:3, 3] = rng.uniform([0.35, -0.25, 0.25], [0.65, 0.25, 0.65])
        return X

    X, Y, Z = pose(), pose(), pose()
    first, second = [pose() for _ in range(20)], [pose() for _ in range(20)]
    seen = []
    for A, C in zip(first, second, strict=True):
        noise = np.eye(4)
        noise[:3, :3] = Rotation.from_rotvec(np.radians(0.01) * rng.normal(size=3)).as_matrix()
        noise[:3, 3] = 1e-4 * rng.normal(size=3)
        seen.append(np.linalg.inv(A @ X) @ Y @ C @ Z @ noise)
    return {"A": first, "B": seen, "C": second, "mode": "co_manipulation"}
