"""The reference of scenario keys is the page in docs, and names every key with its meaning."""

from pathlib import Path

from weldcal.systems.scenario.schema import WeldingConfig
from weldcal.tools.commands.cell.schema import keys_of, reference

PAGE = Path(__file__).resolve().parents[3] / "docs" / "scenario.md"


def test_the_page_in_docs_is_the_one_that_the_command_prints() -> None:
    assert PAGE.read_text(encoding="utf-8") == reference(), "run: weldcal schema --markdown > docs/scenario.md"


def test_a_key_has_the_comment_beside_it_or_above_it() -> None:
    keys = {key.name: key for key in keys_of(WeldingConfig)}
    assert keys["deflection_mm"].meaning.startswith("delta_d of Eq. 16")
    assert (keys["speed_mm_s"].default, keys["speed_mm_s"].kind) == (8.0, float)
    assert keys["process"].parts
    assert "standard digital inputs (0 to 7)" in reference()


def test_a_driver_has_the_keys_of_its_base_classes() -> None:
    page = reference()
    folder = page[page.index("### `scanner: !FolderScanner`") : page.index("### `scanner: !GenicamScanner`")]
    assert "| `folder` |" in folder
    assert "| `preset` | text | `phoxi_m` |" in folder
    assert "from the trigger to the scan" in folder
