"""A scenario file in another encoding, or with a word in a device's place, is refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario


@pytest.mark.parametrize(("encoding", "said"), [("utf-16", "is UTF-16; save it as UTF-8"), ("latin-1", "is not UTF-8")])
def test_a_scenario_in_another_encoding_is_refused(tmp_path: Path, encoding: str, said: str) -> None:
    path = tmp_path / "cell.yaml"
    path.write_bytes("description: Gerät\narm: ur10e\n".encode(encoding))
    with pytest.raises(InputError, match=said):
        load_scenario(str(path))


@pytest.mark.parametrize("value", ["1,5", "null", "word", "-1e308"])
def test_a_device_that_is_a_word_is_refused(tmp_path: Path, value: str) -> None:
    """Drake's reader takes the word for the first of the device's drivers, all of whose keys are then that word."""
    text = (SCENARIO_FOLDER / "profiler_edge.yaml").read_text()
    (tmp_path / "cell.yaml").write_text(text.replace("finger_camera: !NoDevice {}", f"finger_camera: {value}"))
    with pytest.raises(InputError, match="finger_camera"):
        load_scenario(str(tmp_path / "cell.yaml"))
