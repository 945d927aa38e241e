"""Plans the arm's positions in which a fixed scanner sees nozzle, wire, tip and ring of the tool from all sides."""

import dataclasses as dc
from collections import Counter
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.results import load_result
from weldcal.calibration.errors import UnreachableScanner
from weldcal.calibration.geometry.se3 import exp_rotation, frames_along
from weldcal.calibration.planning.calibration_poses import PlannerConfig, plan_calibration_poses, why_not
from weldcal.calibration.planning.clearance import Obstacle, Surroundings, occludes
from weldcal.calibration.tool.measure import NozzlePart
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arms.kinematics import link_frames
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.scanners import ScannerPreset
from weldcal.models.tool import WeldingTool
from weldcal.models.tools.loading import LoadedTool
from weldcal.systems.jobs.weld.settings import SCAN_CLEAR_M
from weldcal.systems.motion.clear_moves import clear_move, station_bodies
from weldcal.systems.scenario.schema import FILE, Scenario
from weldcal.systems.station import Station

FEWEST, MOST = 8, 40
_TRIALS, _CANDIDATES = 2000, 80  # choices: half a minute at most
_LOW_RAD, _HIGH_RAD = np.radians(-40.0), np.radians(40.0)  # of the view over the square to the nozzle, from the wire
_OF_EACH = 4  # scans of the tip, and of the ring; a fit needs three
_SIGHT_M = 0.005  # a choice: a calibrated scanner is known to less
_TRAVEL_RAD = np.pi  # a choice: the last joint turns the nozzle to all sides


@dc.dataclass(kw_only=True)
class ToolScanConfig:
    """`tool_scan:` the arm shows its tool to the scanner."""

    # a result of calibrate or demo: its folder, or calibration.yaml
    result: str = dc.field(default="", metadata=FILE)
    scans: int = 12  # 8 to 40


def check_tool_scan(scenario: Scenario) -> None:
    """Check the tool scan of a scenario.

    Raises:
        InputError: one sentence that says what to change.
    """
    config, scanner = scenario.part(ToolScanConfig), scenario.scanner_config()
    assert config is not None
    if scenario.job.calibrate or scenario.job.weld:
        raise InputError(
            "The tool scan neither calibrates nor welds: write job: {calibrate: false, weld: false}, or run it with"
            " weldcal tool measure --scenario NAME."
        )
    if scanner is None or scanner.mounted_on != "base":
        raise InputError(
            "The arm can show its tool only to a scanner that is fixed in the cell: measure this tool with such a"
            " scanner."
        )
    if not scenario.welds:
        raise InputError("A tool scan needs a welding tool: write tool: {file: my_tool.yaml} in the scenario.")
    if not config.result or not Path(config.result).exists():
        raise InputError(
            f"There is no result of weldcal calibrate at '{config.result}': correct --calibration, or tool_scan.result."
        )
    if not FEWEST <= config.scans <= MOST:
        raise InputError(f"tool_scan.scans must be from {FEWEST} to {MOST}, not {config.scans}.")


@dc.dataclass(frozen=True, eq=False)
class ToolView:
    """The arm's joints (6,) rad at a scan, the direction (3,) in F to the scanner, and whether the tip is in sight."""

    q: Array
    direction_F: Array
    tip: bool = False


def plan_tool_views(scenario: Scenario, station: Station, seed: int) -> tuple[ToolView, ...]:
    """Plan the scans of the tool, in the order in which they are taken; all moves between them are clear.

    Raises:
        UnreachableScanner: too few are clear.
    """
    config, loaded, scanner = scenario.part(ToolScanConfig), scenario.loaded_tool(), scenario.scanner_config()
    assert config is not None
    assert loaded is not None
    assert scanner is not None
    result = load_result(Path(config.result))
    if result.robot and result.robot != scenario.arm:
        raise InputError(f"tool_scan.result is of the arm '{result.robot}', and the scenario has a {scenario.arm}.")
    spec, surroundings = scenario.workpiece, station.surroundings
    if spec is not None and station.cad is not None:
        part = Obstacle("the part", station.cad.mesh.transformed(spec.pose_guess.pose()), SCAN_CLEAR_M)
        surroundings = Surroundings((*surroundings.obstacles, part))
    station = dc.replace(station, surroundings=surroundings)
    cell = _Cell(scenario, station, scanner.scanner(), RigidTransform(result.X_BC), _limits(scenario, station, seed))
    pool, why = _pool(cell, loaded)
    chosen = _spread(cell, pool, config.scans)
    if len(chosen) < config.scans:
        reason = why.most_common(1)[0][0] if why and len(pool) < config.scans else "a move to the next one is not clear"
        raise UnreachableScanner(
            f"Only {len(chosen)} of {config.scans} scans of the tool can be taken, most often because {reason}. Choose"
            f" a home_deg nearer to the scanner's working range, clear that place, or ask for fewer scans, {FEWEST} or"
            " more."
        )
    return (*chosen, *_ring_views(cell, loaded.tool, chosen[-1].q))


@dc.dataclass(frozen=True, eq=False)
class _Cell:
    """What views are planned from; the station's surroundings hold the part."""

    scenario: Scenario
    station: Station
    scanner: ScannerPreset
    X_BC: RigidTransform
    limits: PlannerConfig

    @property
    def home(self) -> Array:
        return np.asarray(np.deg2rad(self.scenario.home_deg))

    def clear(self, q_a: Array, q_b: Array) -> bool:
        return clear_move(self.scenario, self.station, station_bodies(self.station), q_a, q_b)


def _limits(scenario: Scenario, station: Station, seed: int) -> PlannerConfig:
    tool = station.tool
    return PlannerConfig(
        seed=seed,
        table_z_m=scenario.table_height_m(),
        margin_m=scenario.calibration.clearance_m,
        sight_margin_m=_SIGHT_M,
        max_travel_rad=_TRAVEL_RAD,
        surroundings=station.surroundings,
        feature_radius_m=0.5 * tool.ring.outer_m if tool is not None and tool.ring is not None else 0.0,
    )


def _ring_views(cell: _Cell, tool: WeldingTool, q: Array) -> list[ToolView]:
    """Return views of the ring, which most views of the nozzle do not show; none where too few are clear."""
    if tool.ring is None:
        return []
    try:
        poses = plan_calibration_poses(
            cell.station.arm,
            tool.X_FR,
            cell.X_BC,
            cell.scanner,
            2 * _OF_EACH,
            q_start=cell.home,
            config=cell.limits,
            tool=tool.capsules(),
        )
    except UnreachableScanner:
        return []
    views: list[ToolView] = []
    for pose in poses:
        if len(views) < _OF_EACH and cell.clear(q, pose.q) and cell.clear(pose.q, cell.home):
            views.append(ToolView(pose.q, np.asarray(pose.X_BF.inverse() @ cell.X_BC.translation())))
            q = pose.q
    return views


def _pool(cell: _Cell, loaded: LoadedTool) -> tuple[list[ToolView], Counter[str]]:
    """Return views that the arm can take, and how often each obstacle stood against another one."""
    arm, tool, part, limits, scanner = cell.station.arm, loaded.tool, NozzlePart(), cell.limits, cell.scanner
    rng, home, bodies, X_BC = np.random.default_rng(limits.seed), cell.home, station_bodies(cell.station), cell.X_BC
    axes = frames_along(loaded.torch_axis[None])[0].T
    behind = np.array([0.0, part.start_m, part.start_m + 0.5 * part.length_m, part.start_m + part.length_m])
    reach = float(np.abs(arm.stack[:, :3, 3]).sum())
    nozzle = loaded.p_FW - behind[:, None] * axes[2]
    tip = np.array(tool.X_FT.translation())[None]
    pool: list[ToolView] = []
    why: Counter[str] = Counter()
    for k in range(_TRIALS):
        if len(pool) >= _CANDIDATES:
            break
        around, above = 2.0 * np.pi * (0.6180339887 * k % 1.0), rng.uniform(_LOW_RAD, _HIGH_RAD)  # the golden ratio
        d = np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)]) @ axes
        X_CF = _seen_along(rng, scanner, limits.image_margin, d, nozzle[2])
        X_BF = X_BC @ X_CF
        if not _in_view(scanner, X_CF, nozzle, limits.image_margin):
            why["the nozzle does not fit into the scanner's view"] += 1
            continue
        q = nearest_solution(arm, X_BF, home) if float(np.linalg.norm(X_BF.translation())) <= reach else None
        if q is None:
            why["the scanner's working range is out of the arm's reach"] += 1
            continue
        if reason := why_not(arm, q, X_BC, (X_BF @ nozzle.T).T, bodies, home, limits, "nozzle"):
            why[reason] += 1
            continue
        eye, tip_B = np.asarray(X_BC.translation()), (X_BF @ tip.T).T
        shown = _in_view(scanner, X_CF, tip) and not occludes(bodies, link_frames(arm, q), eye, tip_B, _SIGHT_M)[0]
        pool.append(ToolView(q, d, shown))
    return pool, why


def _seen_along(
    rng: np.random.Generator, scanner: ScannerPreset, margin: float, d: Array, middle_F: Array
) -> RigidTransform:
    """Draw a pose X_CF in which the scanner sees a point (3,) of F from the direction d (3,) in F."""
    span = margin * (scanner.far_m - scanner.near_m)
    z = rng.uniform(scanner.near_m + span, 0.5 * (scanner.near_m + scanner.far_m))  # a choice: nearer is sharper
    u, v = rng.uniform(0.25, 0.75, 2) * (scanner.width, scanner.height)
    p_C = z * np.array([(u - scanner.cx) / scanner.fx, (v - scanner.cy) / scanner.fy, 1.0])
    to_eye = -p_C / np.linalg.norm(p_C)
    here, there = frames_along(np.array([d, to_eye]))
    R = RotationMatrix.ProjectToRotationMatrix(exp_rotation(rng.uniform(-np.pi, np.pi) * to_eye) @ there @ here.T)
    return RigidTransform(R, p_C - R @ middle_F)


def _in_view(scanner: ScannerPreset, X_CF: RigidTransform, points_F: Array, margin: float = 0.02) -> bool:
    """Return whether points (N, 3) of F lie in the image and the working range, less a share of the image."""
    x, y, z = X_CF @ points_F.T
    if z.min() < scanner.near_m or z.max() > scanner.far_m:
        return False
    u, v = (scanner.cx + scanner.fx * x / z) / scanner.width, (scanner.cy + scanner.fy * y / z) / scanner.height
    return bool(min(u.min(), v.min()) > margin and max(u.max(), v.max()) < 1.0 - margin)


def _spread(cell: _Cell, pool: list[ToolView], n: int) -> list[ToolView]:
    """Choose ``n`` views in turn, each the farthest from those before; the first ones show the tip too."""
    free = [v for v in pool if cell.clear(v.q, cell.home)]
    chosen: list[ToolView] = []

    def rank(view: ToolView) -> tuple[bool, float]:
        apart = min((1.0 - float(view.direction_F @ c.direction_F) for c in chosen), default=0.0)
        return view.tip and sum(c.tip for c in chosen) < _OF_EACH, apart

    while len(chosen) < n and free:
        before = chosen[-1].q if chosen else cell.home
        best = next((v for v in sorted(free, key=rank, reverse=True) if cell.clear(before, v.q)), None)
        if best is None:
            break
        chosen.append(best)
        free.remove(best)
    return chosen
