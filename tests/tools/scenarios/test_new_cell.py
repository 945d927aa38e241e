"""A new cell is a commented copy of a shipped scenario that loads and means the same."""

import dataclasses as dc
import json
import re
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from pydrake.common.yaml import yaml_load

from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario, scenario_names
from weldcal.tools.commands.cell.new import SCHEMA, write_cell


@pytest.mark.parametrize("name", scenario_names())
def test_a_new_cell_means_what_its_scenario_means(tmp_path: Path, name: str) -> None:
    assert load_scenario(str(write_cell(tmp_path / "mine", name)[0])) == load_scenario(name)


def test_every_key_that_is_commented_out_can_be_written(tmp_path: Path) -> None:
    path, _ = write_cell(tmp_path, "s_groove")
    scenario = load_scenario("s_groove")
    parts = [scenario, *(value for value in vars(scenario).values() if dc.is_dataclass(value))]
    keys = "|".join({field.name for part in parts for field in dc.fields(part)} - {"extends"})
    text, count = re.subn(rf"^( *)# ({keys}): ", r"\1\2: ", path.read_text(), flags=re.MULTILINE)
    assert count > 50
    path.write_text(text)
    assert vars(load_scenario(str(path))) == vars(load_scenario("s_groove"))


def test_no_line_is_longer_than_an_editor_is_wide(tmp_path: Path) -> None:
    text = write_cell(tmp_path, "s_groove")[0].read_text()
    assert max(len(line) for line in text.splitlines() if not line.startswith("description")) <= 132


def test_a_cell_is_never_overwritten(tmp_path: Path) -> None:
    first = write_cell(tmp_path, "s_groove")[0].read_text()
    with pytest.raises(InputError, match=r"There is a cell in .* already"):
        write_cell(tmp_path, "l_groove")
    assert (tmp_path / "cell.yaml").read_text() == first


def test_the_schema_beside_it_knows_every_part_and_the_drivers(tmp_path: Path) -> None:
    write_cell(tmp_path, "s_groove")
    schema = json.loads((tmp_path / SCHEMA).read_text())
    scanner = {option["title"]: option["properties"] for option in schema["properties"]["scanner"]["anyOf"]}
    assert {"!RenderedScanner", "!FolderScanner", "!GenicamScanner", "!NoDevice"} <= scanner.keys()
    assert scanner["!FolderScanner"]["folder"]["type"] == "string"
    assert schema["properties"]["home_deg"] == {"type": "array", "items": {"type": "number"}}
    assert schema["properties"]["welding"]["properties"]["seam_length_mm"]["anyOf"] == [
        {"type": "number"},
        {"type": "null"},
    ]
    assert "field" in str(schema["properties"]["extends"]["description"]) or "shipped" in str(
        schema["properties"]["extends"]
    )
    assert schema["additionalProperties"] is False


@pytest.mark.parametrize("name", scenario_names())
def test_shipped_scenarios_fit_the_schema(tmp_path: Path, name: str) -> None:
    text = re.sub(r"!\w+", "", write_cell(tmp_path, name)[0].read_text())
    Draft202012Validator(json.loads((tmp_path / SCHEMA).read_text())).validate(yaml_load(data=text))


def test_the_schema_refuses_an_unknown_key(tmp_path: Path) -> None:
    write_cell(tmp_path, "s_groove")
    schema = Draft202012Validator(json.loads((tmp_path / SCHEMA).read_text()))
    assert schema.is_valid({"welding": {"speed_mm_s": 5.0}})
    assert not schema.is_valid({"welding": {"speed_mm": 5.0}})
    assert not schema.is_valid({"welding": {"speed_mm_s": "fast"}})
    assert not schema.is_valid({"scanner": {"preset": "phoxi_m", "hots": "a"}})
