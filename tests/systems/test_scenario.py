"""A scenario says everything a cell can be told, and a mistake in it is answered with one sentence before any work."""

from __future__ import annotations

import dataclasses as dc
import re
import types
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.common.yaml import yaml_dump_typed, yaml_load, yaml_load_typed

from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import NoDevice
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.drivers.ur.rtde import UrRtde
from weldcal.systems.scenario.checks import check_numbers, check_scenario
from weldcal.systems.scenario.loading import load_scenario, scenario_class, scenario_names
from weldcal.systems.scenario.parts import surroundings_of
from weldcal.systems.scenario.schema import PoseConfig, Scenario

ONE_OF_EVERYTHING = """
description: Every option, each with a value that is not its default.
extends: s_groove
arm: ur10e
base: {xyz_m: [0.1, 0.2, 0.3], rpy_deg: [180.0, 1.0, 2.0]}
kinematics: my_robot/kinematics.yaml
corrected_kinematics: corrected.yaml
flange: iso9409-1-80-6-m8
tool: pen
robot: !SimulatedUr
  control_period_s: 0.004
  following_error_rad: 0.1
  repeatability_mm: 0.05
  kinematic_error_mm: 0.3
robot_2: !SimulatedUr
  control_period_s: 0.008
  following_error_rad: 0.2
  repeatability_mm: 0.04
  kinematic_error_mm: 0.2
scanner: !RenderedScanner
  preset: azure_kinect
  width: 320
  height: 288
  field_of_view_deg: 70.0
  xyz_m: [0.6, 0.1, 1.0]
  rpy_deg: [175.0, 1.0, -80.0]
  mounting_translation_mm: 5.0
  mounting_rotation_deg: 0.5
  exposure_s: 0.05
  scale_error: -0.001
  gradient_error_per_m: [0.01, -0.02]
  warp_mm: 0.05
  mounted_on: flange
  knock_s: 3.0
  knock_mm: [0.3, 0.0, -0.2]
  knock_deg: [0.0, 0.05, 0.0]
finger_camera: !RenderedFingerCamera
  width: 320
  height: 240
  focal_px: 225.0
  rate_hz: 60.0
  latency_s: 0.02
  noise_grey: 1.0
  hidden_from_s: 3.0
motion:
  centre_m: [0.6, 0.05, 0.35]
  edge_mm: 150.0
  lean_deg: 10.0
  frames: 200
  speed_m_s: 0.2
  queue: 3
  record: true
  recording_folder: "recording"
  watch: "calibration"
  false_alarms_per_hour: 0.01
wrist_camera: !RenderedWristCamera
  xyz_m: [0.07, 0.01, 0.04]
  rpy_deg: [1.0, 2.0, 91.0]
  mounting_translation_mm: 3.0
  mounting_rotation_deg: 1.0
  width: 800
  height: 600
  focal_px: 700.0
  noise_grey: 1.0
  depth_scale: 0.99
  depth_noise_mm: 0.5
digitizer: !SimulatedTablet
  placement_translation_mm: 2.0
  placement_rotation_deg: 1.0
  touch_noise_px: 0.2
  touch_force_N: 0.05
tablet:
  xyz_m: [0.55, 0.05, 0.02]
  rpy_deg: [180.0, 1.0, 2.0]
  columns: 4
  rows: 2
  across_mm: 50.0
  down_mm: 40.0
  ring_mm: 9.0
  margin_mm: 20.0
  px_per_mm: 6.0
  pen: {tip_m: [0.0, -0.03, 0.15], mounting_mm: 2.0, radius_mm: 0.8, stiffness_N_per_m: 250.0}
  look_distance_mm: 280.0
  clearance_mm: 14.0
  descent_mm_s: 10.0
  deepest_mm: 11.0
  turn_deg: 20.0
  tilt_deg: 10.0
touch_probe: !UrTouchProbe
  host: 192.168.1.10
  input: 3
  normally_closed: true
  latency_s: 0.002
power_source: !SimulatedPowerSource
  current_A: 150.0
  voltage_V: 22.0
  ignition_s: 0.2
  response_s: 0.1
  stick_out_mm: 18.0
  noise: 0.01
profiler: !RenderedProfiler
  xyz_m: [0.08, 0.01, 0.05]
  rpy_deg: [1.0, 0.0, 80.0]
  mounting_translation_mm: 2.0
  mounting_rotation_deg: 1.0
  samples: 300
  nearest_mm: 55.0
  farthest_mm: 300.0
  width_near_mm: 45.0
  width_far_mm: 150.0
  noise_mm: 0.05
  jitter_mm: 0.02
  quantum_mm: 0.05
  share_missing: 0.02
  share_spikes: 0.01
  grazing_deg: 75.0
  exposure_s: 0.008
profiler_job:
  stages: [sphere, seam]
  torch: {tip_m: [0.01, 0.0, 0.13], error_mm: 1.0}
  straightedge:
    xyz_m: [0.6, 0.0, 0.15]
    rpy_deg: [5.0, -4.0, 30.0]
    length_mm: 150.0
    width_mm: 25.0
    translation_mm: 2.0
    rotation_deg: 0.5
  ball: {xyz_m: [0.65, 0.2, 0.15], radius_mm: 15.0, translation_mm: 2.0}
  edge: {scans: 20, held_out: 4, tilt_deg: 20.0}
  sphere: {scans: 20, held_out: 4, touches: 12, tilt_deg: 20.0, descent_mm_s: 5.0, gap_mm: 9.0, deepest_mm: 9.0}
  seam:
    passes: 1
    pass_mm_s: 20.0
    every_mm: 3.0
    stand_off_mm: 90.0
    torch_mm_s: 10.0
    above_root_mm: 3.0
    ends_mm: 10.0
    seam_length_mm: 100.0
  robot_sigma_mm: 0.03
  clearance_mm: 8.0
  near_mm: 70.0
  far_mm: 100.0
  half_width_mm: 15.0
  maximum_time_s: 300.0
home_deg: [1.0, -81.0, 111.0, -121.0, -91.0, 1.0]
tool_scan: {result: my-calibration, scans: 9}
touch:
  result: my-calibration
  points: 5
  aside_mm: 8.0
  clearance_mm: 12.0
  descent_mm_s: 2.0
  press_mm: 0.8
  deepest_mm: 4.0
  turn_deg: 10.0
mounting:
  target_known: false
  spread_deg: 20.0
  travel_deg: 60.0
  second_arm:
    arm: ur10e
    xyz_m: [1.8, 0.1, 0.02]
    rpy_deg: [1.0, 2.0, 170.0]
    placement_translation_mm: 10.0
    placement_rotation_deg: 0.5
    home_deg: [1.0, -81.0, 111.0, -121.0, -91.0, 1.0]
calibration:
  configuration: co_manipulation
  feature: flange
  mounting_guess: {xyz_m: [0.6, 0.1, 1.0], rpy_deg: [170.0, 2.0, -85.0]}
  guess_radius_mm: 40.0
  theta_max_deg: 20.0
  required_error_mm: 0.2
  minimum_scans: 5
  correct_scanner: false
  refine: links
  maximum_scans: 9
  verification_scans: 2
  verification_limit_mm: 0.4
  table_z_m: -0.01
  clearance_m: 0.04
  work_point_m: [0.5, 0.1, 0.0]
workpiece:
  shape: l
  file: bracket.step
  units: mm
  joint: fillet
  seams:
    - {polyline: seam.csv, edges: [12, 13], direction: reverse, start_mm: 5.0, end_mm: 6.0, feel: false,
       angles: {work_angle_deg: 1.0, travel_angle_deg: [-2.0, -1.0], wire_rotation_deg: 1.5, stick_out_mm: 13.0}}
  length_mm: 250.0
  pose_guess: {xyz_m: [0.6, 0.0, 0.03], rpy_deg: [0.0, 0.0, 80.0]}
  placement_error: {translation_mm: 1.0, rotation_deg: 0.2}
  groove_error: {translation_mm: 1.5, rotation_deg: 0.3}
  hole_from_mm: 200.0
  bend_radius_mm: 250.0
  located_by: drawing
surroundings:
- name: fence
  box_m: [0.02, 2.0, 1.0]
  mesh: fence.stl
  unit: m
  pose: {xyz_m: [1.2, 0.1, 0.5], rpy_deg: [1.0, 2.0, 3.0]}
  margin_m: 0.05
planning: {method: cloud, search: anywhere, scan_poses_deg: [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]], start_m: [0.6, -0.1, 0.0]}
welding:
  speed_mm_s: 6.0
  deflection_mm: 1.5
  axial_deflection_mm: 2.5
  clearance_mm: 30.0
  seam_length_mm: 100.0
  process: {name: TIG, current_A: 90.0, voltage_V: 11.0, efficiency: 0.55, wire_feed_m_min: 1.2}
  arc: {start: rest, start_s: 0.4, crater_s: 0.6}
  schedule:
    job: 3
    wire_feed_m_min: 8.0
    voltage_V: 24.0
    current_A: 200.0
    hot_start: {wire_feed_m_min: 9.0, voltage_V: 25.0, current_A: 210.0, time_s: 0.4, ramp_s: 0.3}
    crater: {wire_feed_m_min: 5.0, voltage_V: 20.0, current_A: 120.0, ramp_s: 0.4}
    by_gap: [{gap_mm: 0.5, wire_feed_m_min: 8.0, voltage_V: 24.0, current_A: 200.0, speed_mm_s: 7.0}]
  order: {order: o, wps: w, wpqr: q, drawing: d, part: p, serial: s, batch: b, operator: x, material: m, filler: f,
    filler_batch: fb, gas: g, position: PA, note: n, limits: {heat_input_kJ_mm: [0.5, 1.0], speed_mm_s: [7.0, 9.0],
    current_A: [80.0, 100.0], voltage_V: [10.0, 12.0], path_mm: 0.4}}
  angles: {work_angle_deg: [1.0, 2.0], travel_angle_deg: -1.5, wire_rotation_deg: 2.0, stick_out_mm: 14.0}
  weave: {shape: crescent, amplitude_mm: 1.5, frequency_hz: 1.5, dwell_s: [0.1, 0.2], bow_mm: 0.5, plane_deg: 10.0}
  stitch: {on_mm: 20.0, off_mm: 40.0, from_mm: 5.0, order: middle_out}
  tacks: [{from_mm: 50.0, to_mm: 60.0, height_mm: 5.0, seam: 2}]
  passes: [{lateral_mm: 1.0, vertical_mm: 3.0, angle_deg: 5.0, travel_angle_deg: 6.0, speed_mm_s: 9.0,
            reverse: true, interpass_s: 30.0}]
  lean_deg: 4.0
  tolerance_mm: 0.4
  pass_obstacles: true
  seam_order: least_travel
  between_seams: direct
  fit_up: limits.csv
  posture: any
job:
  calibrate: false
  weld: false
  X_BC: {xyz_m: [0.61, 0.11, 1.01], rpy_deg: [171.0, 3.0, -84.0]}
  X_FC: {xyz_m: [0.01, 0.02, 0.03], rpy_deg: [1.0, 2.0, 3.0]}
  X_BC_sigma_mm: 0.1
  speed_factor: 0.5
  maximum_time_s: 100.0
visualization:
  recording_fps: 20.0
  cloud_points: 5000
"""
ONLY_ONE_CHOICE = {"arm"}  # there is one arm so far: its default cannot be departed from


@pytest.fixture
def everything() -> Scenario:
    scenario: Scenario = yaml_load_typed(schema=scenario_class(), data=ONE_OF_EVERYTHING)
    return scenario


def sections(schema: Any) -> list[type]:
    """The dataclasses that a field of this type may hold."""
    if dc.is_dataclass(schema):
        return [typing.cast(type, schema)]
    if isinstance(schema, types.UnionType) or typing.get_origin(schema) is typing.Union:
        return [section for choice in typing.get_args(schema) for section in sections(choice)]
    return []


def compare(schema: type, text: dict[str, Any], value: Any, default: Any, where: str = "") -> list[str]:
    """What of a dataclass tree the text leaves out, the loader lost, or the text sets to its default."""
    hints: dict[str, Any] = {field.name: field.type for field in dc.fields(schema)}
    wrong = [f"{where}{key} is not in the text" for key in hints.keys() - text.keys()]
    for key in hints.keys() & text.keys():
        written, loaded = text[key], getattr(value, key)
        if sections(hints[key]) and not isinstance(loaded, str):
            assert isinstance(loaded, tuple(sections(hints[key])))
            below = {k: v for k, v in written.items() if k != "_tag"}
            wrong += compare(type(loaded), below, loaded, type(loaded)(), f"{where}{key}.")
            continue
        if isinstance(loaded, list) and loaded and all(dc.is_dataclass(item) for item in loaded):
            for k, (words, item) in enumerate(zip(written, loaded, strict=True)):
                wrong += compare(type(item), words, item, type(item)(), f"{where}{key}[{k}].")
            continue
        if loaded != written:
            wrong.append(f"{where}{key} was lost: {written} became {loaded}")
        if loaded == getattr(default, key) and key not in ONLY_ONE_CHOICE:
            wrong.append(f"{where}{key} is left at its default")
    return wrong


@pytest.mark.parametrize("name", scenario_names())
def test_every_shipped_scenario_loads_and_says_what_it_shows(name: str) -> None:
    assert load_scenario(name).description


def test_the_demo_ships() -> None:
    assert "s_groove" in scenario_names()


def test_one_of_everything_sets_every_option_and_none_is_lost(everything: Scenario) -> None:
    assert compare(scenario_class(), yaml_load(data=ONE_OF_EVERYTHING), everything, scenario_class()()) == []


def test_one_of_everything_survives_being_written_and_read_again(everything: Scenario) -> None:
    assert (
        yaml_load_typed(schema=scenario_class(), data=yaml_dump_typed(everything, schema=scenario_class()))
        == everything
    )


def test_a_scenario_has_one_job(everything: Scenario) -> None:
    with pytest.raises(InputError, match="one job"):
        check_scenario(everything)


def test_overrides_change_what_they_name_and_nothing_else() -> None:
    plain, changed = load_scenario("s_groove"), load_scenario("s_groove", "welding: {speed_mm_s: 5.0}")
    assert changed.welding.speed_mm_s == 5.0
    changed.welding.speed_mm_s = plain.welding.speed_mm_s
    assert changed == plain


ROBOT_OF_ITS_OWN = """
robot: !UrRtde
  host: 192.168.1.10
  transport: native
  rate_hz: 500.0
  pace: 0.5
  lockstep: true
  follow: true
  velocity_share: 0.3
  upper_registers: false
  payload_kg: 2.0
  payload_cog_m: [0.01, 0.02, 0.06]
  process_output: 3
  arc_input: 1
  arc_fault_input: 2
  gas_output: 4
  gas_before_s: 0.2
  gas_after_s: 2.0
  wire_feed: {output: 1, unit: mA, at_zero: 1.0, at_full: 22.0, value: 8.0}
  arc_voltage: {output: 1, unit: mA, at_zero: 10.0, at_full: 40.0, value: 21.5}
"""


def test_one_word_changes_the_robot_and_none_of_its_options_is_lost() -> None:
    loaded = load_scenario("s_groove", ROBOT_OF_ITS_OWN)
    assert isinstance(loaded.robot, UrRtde)
    text = {k: v for k, v in yaml_load(data=ROBOT_OF_ITS_OWN)["robot"].items() if k != "_tag"}
    assert compare(UrRtde, text, loaded.robot, UrRtde()) == []
    shipped = load_scenario("s_groove")
    loaded.robot = shipped.robot
    assert vars(loaded) == vars(shipped)


def test_a_device_can_be_said_to_be_absent() -> None:
    loaded = load_scenario("s_groove", "finger_camera: !NoDevice {}\njob: {weld: false}")
    assert isinstance(loaded.finger_camera, NoDevice)


def test_a_pose_is_written_in_metres_and_degrees() -> None:
    X = PoseConfig([0.1, 0.2, 0.3], [180.0, 0.0, -90.0]).pose()
    assert X.translation().tolist() == [0.1, 0.2, 0.3]
    assert X.rotation().matrix()[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-15)
    assert X.rotation().matrix()[:, 0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-15)


@pytest.mark.parametrize(
    "pose", [PoseConfig([0.1, 0.2]), PoseConfig(rpy_deg=[0.0] * 4), PoseConfig([0.0, 0.0, float("nan")])]
)
def test_a_pose_needs_three_and_three_finite_numbers(pose: PoseConfig) -> None:
    with pytest.raises(InputError, match=r"(xyz_m|rpy_deg) must (hold 3 numbers|be finite)"):
        check_numbers(pose)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ("arm: aubo_i5", "'aubo_i5' is none of them"),
        ("arm: ur3e\nrobot: !UrRtde {payload_kg: 3.5}", "the payload of a ur3e is 3 kg"),
        ("home_deg: [.nan, 0, 0, 0, 0, 0]", "home_deg must be finite"),
        (
            "home_deg: [0.0, -80.0, 200.0, -120.0, -90.0, 0.0]",
            (
                "home_deg puts joint 3 of the ur10e at 200 deg, and its limits are -180 to 180 deg: give an angle"
                " between them."
            ),
        ),
        ("calibration: {work_point_m: [1, 2]}", "calibration.work_point_m must hold 3 numbers, not 2"),
        ("robot: !UrRtde {payload_cog_m: [1, 2]}", "robot.payload_cog_m must hold 3 numbers, not 2"),
        ("robot: !UrRtde {payload_kg: -1}", "robot.payload_kg must not be negative"),
        ("robot: !UrRtde {rate_hz: 0}", "robot.rate_hz must be a positive number"),
        ("robot: !UrRtde {pace: 0}", "robot.pace must be a positive number"),
        ("robot: !UrRtde {velocity_share: 0}", "robot.velocity_share must be a positive number"),
        ("job: {speed_factor: 0.01}", "job.speed_factor must be from 0.05 to 1, and it is 0.01"),
        ("job: {speed_factor: 1.5}", "job.speed_factor must be from 0.05 to 1, and it is 1.5"),
        ("finger_camera: !RenderedFingerCamera {rate_hz: 0}", "finger_camera.rate_hz must be a positive number"),
        ("calibration: {verification_limit_mm: .nan}", "calibration.verification_limit_mm must be finite"),
        ("calibration: {verification_scans: -1}", "calibration.verification_scans must not be negative"),
        ("welding: {seam_length_mm: -5}", "welding.seam_length_mm must be a positive number"),
        ("welding: {speed_mm_s: fast}", "at 'welding'"),
        ("scanner: !RenderedScanner {width: 20000}", "scanner.width is 20000; it may be at most 4096"),
        ("scanner: !RenderedScanner {width: '1,5'}", "at 'scanner': invalid literal for int"),
        ("scanner: !RenderedScanner {width: 1.5}", "at 'scanner': Expected a"),
        ("visualization: {recording_fps: 1.0e+9}", "visualization.recording_fps is 1e+09"),
        ("visualization: {cloud_points: null}", "at 'visualization': Expected a"),
        ("workpiece: {length_mm: 1.0e+7}", "workpiece.length_mm is 1e+07"),
        ("workpiece: {pose_guess: {xyz_m: [5.0, 0.0, 0.0]}}", "5 m from the robot"),
        ("planning: {start_m: [a, b, c]}", "at 'planning': could not convert"),
        (f"calibration: {{maximum_scans: {'9' * 400}}}", "calibration.maximum_scans is beyond 1e+09"),
        ("job: {calibrate: false, weld: false}", "nothing to do: set job.calibrate or job.weld"),
        ("arm: ur10e\narm: ur10e", "gives the key 'arm' twice"),
        ("home_deg: 5", "at 'home_deg'"),
    ],
)
def test_a_number_that_no_cell_can_work_with_is_named(overrides: str, named: str) -> None:
    with pytest.raises(InputError, match=re.escape(named)):
        load_scenario("s_groove", overrides)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ("speeling: 1", "'speeling'"),
        ("welding: {speed_mm_per_s: 3}", "'speed_mm_per_s'"),
        ("robot: !SimulatedUr {following_eror_rad: 1}", "'following_eror_rad'"),
        ("robot: !RealUr {}", "robot: there is no driver '!RealUr'"),
        (
            "scanner: !RenderedFingerCamera {}",
            "scanner: there is no driver '!RenderedFingerCamera'; the nearest one is '!RenderedScanner'",
        ),
        ("job: {calibrate: maybe}", "'calibrate'.*maybe"),
        ("calibration: {minimum_scans: 4.5}", "'minimum_scans'.*4.5"),
        ("description: 3", "'description'"),
        ("job: [", "line 1"),
        ("- 1", "list"),
        ("welding: {speed_mm_s: .nan}", "welding.speed_mm_s"),
        ("welding: {speed_mm_s: -8.0}", "welding.speed_mm_s"),
        ("calibration: {required_error_mm: 0.0}", "calibration.required_error_mm"),
        ("calibration: {theta_max_deg: .inf}", "calibration.theta_max_deg"),
        ("job: {maximum_time_s: 0}", "job.maximum_time_s"),
        ("home_deg: [0.0, 1.0]", "home_deg"),
        ("calibration: {feature: elbow}", "calibration.feature.*'elbow'"),
        ("tool: gripper", "tool must be.*'gripper'"),
        ("calibration: {minimum_scans: 3}", "calibration.minimum_scans must be at least 4"),
    ],
)
def test_a_mistake_is_answered_with_one_sentence_that_names_it(overrides: str, named: str) -> None:
    with pytest.raises(InputError, match=named) as answer:
        load_scenario("s_groove", overrides)
    assert "\n" not in str(answer.value)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ("tool: none", "feature tool_ring goes with tool: welding"),
        ("calibration: {feature: flange}", "and flange with tool: none"),
        ("calibration: {minimum_scans: 8, maximum_scans: 7}", "not above calibration.maximum_scans"),
        ("workpiece: null", "A weld needs a workpiece"),
        ("finger_camera: !NoDevice {}", "and a finger_camera"),
        ("tool: none\ncalibration: {feature: flange}", "A weld needs .* tool: welding"),
        ("robot: !NoDevice {}", "A cell needs a robot"),
        ("scanner: !NoDevice {}", "This job needs a scanner"),
        ("scanner: !NoDevice {}\njob: {calibrate: false, X_BC: {xyz_m: [0.0, 0.0, 1.0]}}", "This job needs a scanner"),
    ],
)
def test_two_settings_that_contradict_each_other_are_refused(overrides: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("s_groove", overrides)


ALONE = "job: {calibrate: false, X_FC: null}\n"
SCANNERS = pytest.mark.parametrize(("name", "key"), [("s_groove", "X_BC"), ("carried_scanner", "X_FC")])


@SCANNERS
def test_a_weld_alone_takes_a_simulated_scanners_nominal_pose(name: str, key: str) -> None:
    scenario = load_scenario(name, ALONE)
    scanner = scenario.scanner
    assert isinstance(scanner, RenderedScanner)
    assert getattr(scenario.job, key) == PoseConfig(scanner.xyz_m, scanner.rpy_deg)
    assert scanner.mounting_translation_mm == scanner.mounting_rotation_deg == 0.0


def test_a_stated_pose_leaves_the_simulated_scanner_where_it_is() -> None:
    scenario = load_scenario("s_groove", "job: {calibrate: false, X_BC: {xyz_m: [0.1, 0.2, 0.3]}}")
    assert scenario.job.X_BC is not None
    assert scenario.job.X_BC.xyz_m == [0.1, 0.2, 0.3]
    assert isinstance(scenario.scanner, RenderedScanner)
    assert scenario.scanner.mounting_translation_mm == 15.0


@SCANNERS
def test_a_real_scanner_without_a_pose_gets_a_line_to_paste(name: str, key: str) -> None:
    carried = "mounted_on: flange" if key == "X_FC" else "mounted_on: base"
    real = f"scanner: !FolderScanner {{folder: scans, {carried}}}\n"
    with pytest.raises(InputError) as refused:
        load_scenario(name, real + ALONE)
    line = str(refused.value)[str(refused.value).index("job: {") :]
    scenario = load_scenario(name, real + line)
    assert getattr(scenario.job, key) == scenario.calibration.mounting_guess


@pytest.mark.parametrize(
    ("robot", "probe", "said"),
    [
        (
            "arc_input: 4, arc_fault_input: 4",
            "host: 10.0.0.9, input: 4",
            "robot.arc_input and robot.arc_fault_input are both",
        ),
        (
            "arc_input: 4, arc_fault_input: 5",
            "host: 10.0.0.1, input: 5",
            "robot.arc_fault_input and touch_probe.input are both",
        ),
        ("arc_input: 4, arc_fault_input: 5", "host: 10.0.0.9, input: 5", None),
    ],
    ids=["arc and fault", "fault and probe", "another controller"],
)
def test_an_input_of_the_controller_shows_one_thing(robot: str, probe: str, said: str | None) -> None:
    text = f"robot: !UrRtde {{host: 10.0.0.1, {robot}}}\ntouch_probe: !UrTouchProbe {{{probe}}}"
    if said is None:
        load_scenario("s_groove", text)
        return
    with pytest.raises(InputError, match=f"{said} digital input [45]: wire them to two inputs"):
        load_scenario("s_groove", text)


def test_the_first_of_two_faults_is_named_and_the_second_when_that_is_mended() -> None:
    scenario = load_scenario("s_groove")
    scenario.home_deg = scenario.home_deg[:5]
    scenario.welding.speed_mm_s = -1.0
    with pytest.raises(InputError, match="home_deg"):
        check_scenario(scenario)
    scenario.home_deg = [*scenario.home_deg, 0.0]
    with pytest.raises(InputError, match=r"welding\.speed_mm_s"):
        check_scenario(scenario)


def test_an_unknown_scenario_is_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"There is no scenario 'moon': .*[Cc]hoose one of .*s_groove"):
        load_scenario("moon")
    with pytest.raises(InputError, match=r"There is no scenario 'moon\.yaml'"):
        load_scenario("moon.yaml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("welding: {law: guarded}", "key welding.law was removed: leave it out"),
        ("calibration: {cost: money}", "key calibration.cost was removed: .*--compare"),
        ("workpiece: {located_by: luck}", "scan or drawing"),
        ("workpiece: {bend_radius_mm: -1.0, located_by: drawing}", "bend_radius_mm must be a positive number"),
    ],
)
def test_a_law_or_workpiece_that_is_not_to_be_had_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_scenario("s_groove", text)


FENCED = """
surroundings:
- {name: fence, box_m: [0.02, 2.0, 1.0], pose: {xyz_m: [1.2, 0.0, 0.5]}}
- {mesh: %s, unit: mm, pose: {xyz_m: [0.3, -0.6, 0.0]}, margin_m: 0.05}
"""


def test_surroundings_are_boxes_and_mesh_files_in_the_base(tmp_path: Path) -> None:
    (tmp_path / "fixture.obj").write_text("v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n")
    (tmp_path / "my.yaml").write_text(FENCED % "fixture.obj")
    fence, fixture = surroundings_of(
        load_scenario(str(tmp_path / "my.yaml"), "robot: !SimulatedUr {}\njob: {weld: false}")
    ).obstacles
    assert (fence.name, fixture.name) == ("fence", "surroundings 2")
    assert fence.mesh.bounds == pytest.approx(np.array([[1.19, -1.0, 0.0], [1.21, 1.0, 1.0]]))
    assert fixture.mesh.bounds == pytest.approx(np.array([[0.3, -0.6, 0.0], [0.4, -0.5, 0.0]]))
    assert fixture.margin_m == 0.05


@pytest.mark.parametrize(
    ("obstacle", "named"),
    [
        ("{}", r"surroundings\[0\] needs either box_m: \[x, y, z\] or mesh: FILE"),
        ("{box_m: [1.0, 1.0, 0.0]}", r"surroundings\[0\].box_m needs three positive lengths"),
        ("{box_m: [1.0, 1.0]}", r"surroundings\[0\].box_m must hold 3 numbers, not 2"),
        ("{box_m: [1.0, 1.0, .nan]}", r"surroundings\[0\].box_m must be finite"),
        ("{mesh: nowhere.stl}", "There is no file 'nowhere.stl'"),
        ("{mesh: README.md}", "'README.md' is no part that can be read"),
        ("{mesh: nowhere.stl, unit: km}", "units must be mm, m, inch, not 'km'"),
        ("{box_m: [1.0, 1.0, 1.0], margin_m: -0.1}", r"surroundings\[0\].margin_m must not be negative"),
    ],
)
def test_an_obstacle_that_cannot_be_built_is_refused_in_a_sentence(obstacle: str, named: str) -> None:
    with pytest.raises(InputError, match=named):
        surroundings_of(load_scenario("s_groove", f"surroundings: [{obstacle}]"))


def test_a_scenario_extends_a_shipped_one_or_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: s_groove\nwelding: {speed_mm_s: 5.0}\n")
    (tmp_path / "slow.yaml").write_text("extends: mine.yaml\njob: {speed_factor: 0.5}\n")
    shipped, slow = load_scenario("s_groove"), load_scenario(str(tmp_path / "slow.yaml"))
    assert (slow.welding.speed_mm_s, slow.job.speed_factor) == (5.0, 0.5)
    assert slow.scanner == shipped.scanner
    assert slow.workpiece == shipped.workpiece


def test_a_file_named_in_a_base_is_looked_for_beside_the_base(tmp_path: Path) -> None:
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "clamp.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "cell" / "base.yaml").write_text("extends: s_groove\nsurroundings: [{mesh: clamp.obj}]\n")
    (tmp_path / "job.yaml").write_text("extends: cell/base.yaml\n")
    loaded = load_scenario(str(tmp_path / "job.yaml"))
    assert loaded.surroundings[0].mesh == str(tmp_path / "cell" / "clamp.obj")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("extends: nowhere\n", "mine.yaml extends 'nowhere', which does not exist: choose one of"),
        ("extends: mine.yaml\n", "mine.yaml extends itself through mine.yaml"),
    ],
)
def test_a_base_that_cannot_be_used_is_named(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=named):
        load_scenario(str(tmp_path / "mine.yaml"))


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ("weldin: {speed_mm_s: 5}", "the key 'weldin' is not known; the nearest one is 'welding'"),
        ("welding: {speed_mm: 5}", "the key 'speed_mm' in welding is not known; the nearest one is 'speed_mm_s'"),
        ("robot: !UrRtde {hots: a}", "the key 'hots' in robot is not known; the nearest one is 'host'"),
        ("surroundings: [{nam: a}]", r"the key 'nam' in surroundings\[0\] is not known; the nearest one is 'name'"),
        ("workpiece: {pose_guess: {xyz: [0, 0, 0]}}", "'xyz' in workpiece.pose_guess .* nearest one is 'xyz_m'"),
    ],
)
def test_an_unknown_key_is_answered_with_the_nearest_known_one(overrides: str, named: str) -> None:
    with pytest.raises(InputError, match=named):
        load_scenario("s_groove", overrides)


@pytest.mark.parametrize("tool", ["0", "7", ""])
def test_a_tool_that_is_a_number_is_refused(tmp_path: Path, tool: str) -> None:
    (tmp_path / "cell.yaml").write_text(f"tool: {tool}\n")
    with pytest.raises(InputError, match=r"tool is welding|names a file, not 7|cannot be read"):
        load_scenario(str(tmp_path / "cell.yaml"))
