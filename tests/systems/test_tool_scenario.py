"""A scenario with a tool of one's own: found beside the scenario, used by every part of the cell, refused where it
cannot work."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.models.tools.loading import WELDING
from weldcal.systems.drivers.simulated.rendered_finger_camera import RenderedFingerCamera
from weldcal.systems.jobs.weld.settings import feature_standard, servo_config
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario
from weldcal.systems.station import make_station
from weldcal.tools.commands.run import robot_at

LONGER = (("-60.0, 0.0, 171.5", "-80.0, 0.0, 173.0"), ("[0.0, 0.0, 170.0]", "[0.0, 0.0, 172.0]"))
SMALL_RING = (("standard: tool-ring-63", "outer_mm: 50.0\n  bore_mm: 25.0"),)


def cell(tmp_path: Path, *changes: tuple[str, str], more: str = "") -> str:
    """A copy of the demo with the welding tool's file, changed, in a folder beside it."""
    text = WELDING.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "tools").mkdir(exist_ok=True)
    (tmp_path / "tools/my_tool.yaml").write_text(text)
    scenario = tmp_path / "my_cell.yaml"
    demo = (SCENARIO_FOLDER / "s_groove.yaml").read_text()
    scenario.write_text(f"{demo}tool: {{file: tools/my_tool.yaml}}\n{more}")
    return str(scenario)


def test_every_part_of_the_cell_has_the_files_tool(tmp_path: Path) -> None:
    changes = (*LONGER, *SMALL_RING, ("focal_px: 450.0", "focal_px: 430.0"), ("mass_kg: 1.4", "mass_kg: 1.1"))
    scenario = load_scenario(cell(tmp_path, *changes))
    assert feature_standard(scenario).outer_m == pytest.approx(0.050)
    assert isinstance(scenario.finger_camera, RenderedFingerCamera)
    assert scenario.finger_camera.focal_px == 430.0
    assert robot_at("127.0.0.1", scenario).payload_kg == 1.1
    with closing(make_station(scenario, 0)) as station:
        assert station.tool is not None
        assert station.tool.chord_m == pytest.approx(0.080)
        geometry = servo_config(scenario, station).tool
        assert geometry.torch_offset_m == pytest.approx(0.080)
        assert geometry.torch_height_m == pytest.approx(-0.001)
        assert station.world is not None
        plant = station.world.plant
        assert plant.GetBodyByName("tool_plate").default_mass() == pytest.approx(1.1)
        context = plant.CreateDefaultContext()
        flange, tip = (plant.GetFrameByName(name).CalcPoseInWorld(context) for name in ("flange", "tip_z"))
        assert (flange.inverse() @ tip).translation() == pytest.approx([0.0, 0.0, 0.172])


def test_the_tools_ring_and_weight_are_checked_against_the_cell(tmp_path: Path) -> None:
    ring = WELDING.read_text()
    ring = ring[ring.index("ring:") : ring.index("tip:")]
    with pytest.raises(InputError, match=r"my_tool\.yaml has no ring to measure: write calibration\.feature: flange"):
        load_scenario(cell(tmp_path, (ring, "")))
    loaded = load_scenario(cell(tmp_path, (ring, "")), "calibration: {feature: flange}")
    assert feature_standard(loaded).designation == "iso9409-1-50-4-m6"
    heavy = cell(tmp_path, ("mass_kg: 1.4", "mass_kg: 3.4"), more="arm: ur3e\n")
    with pytest.raises(InputError, match=r"The tool weighs .* kg, and the payload of a ur3e is 3 kg"):
        load_scenario(heavy)
    with pytest.raises(
        InputError, match=r"robot.payload_kg is 0.5 kg, and the tool of .* weighs 1.4 kg: make them equal"
    ):
        load_scenario(cell(tmp_path), "robot: !UrRtde {payload_kg: 0.5}")
    with pytest.raises(InputError, match="There is no tool file"):
        load_scenario("s_groove", "tool: {file: none.yaml}")
    with pytest.raises(InputError, match=r"tool must be welding, pen, none or \{file: my_tool.yaml\}, not 'torch'"):
        load_scenario("s_groove", "tool: torch")
    assert np.isfinite(loaded.table_height_m())
