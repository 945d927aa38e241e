"""Scanner files: any preset can be written as one, unknown keys name the nearest, impossible scanners are refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from weldcal.models.errors import InputError
from weldcal.models.scanners import SCANNERS, get_scanner
from weldcal.systems.drivers.simulated.rendered_scanner import RenderedScanner
from weldcal.systems.scenario.loading import SCENARIO_FOLDER, load_scenario

PHOXI_M = SCANNERS["phoxi_m"]
TEXT: dict[str, Any] = {
    "width": 2064,
    "height": 1544,
    "fx": PHOXI_M.fx,
    "near_mm": 458.0,
    "far_mm": 1118.0,
    "optimum_mm": 650.0,
}


def written(folder: Path, **changes: Any) -> Path:
    file = folder / "mine.yaml"
    file.write_text(yaml.safe_dump({k: v for k, v in (TEXT | changes).items() if v is not None}))
    return file


def test_a_preset_written_as_a_file_is_that_preset(tmp_path: Path) -> None:
    found = get_scanner(str(written(tmp_path, name="phoxi_m")))
    for key in ("width", "height", "fx", "fy", "cx", "cy", "near_m", "far_m", "optimum_m", "name"):
        assert getattr(found, key) == getattr(PHOXI_M, key), key
    for key, value in vars(PHOXI_M.noise).items():
        assert getattr(found.noise, key) == pytest.approx(value), key
    assert get_scanner(str(tmp_path / "mine.yaml"), width=1032).fx == pytest.approx(0.5 * PHOXI_M.fx)


def test_a_field_of_view_gives_the_focal_length(tmp_path: Path) -> None:
    found = get_scanner(str(written(tmp_path, fx=None, field_of_view_deg=60.0, cx=1000.0)))
    assert found.fx == found.fy == pytest.approx(0.5 * 2064 / math.tan(math.radians(30.0)))
    assert (found.cx, found.cy) == (1000.0, 771.5)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"widht": 5}, "widht is not a known key: did you mean width"),
        ({"noise": {"sigma": 0.1}}, r"noise\.sigma is not a known key: did you mean"),
        ({"noise": {"flying": 1.5}}, "chances of a depth noise model lie between 0 and 1"),
        ({"fx": None}, r"needs fx \(px\), or field_of_view_deg"),
        ({"field_of_view_deg": 60.0}, "not both"),
        ({"near_mm": 1200.0}, "near_mm must be positive and below far_mm"),
        ({"optimum_mm": 300.0}, "optimum_mm must lie in the range"),
        ({"width": 0}, "width and height must be from 8"),
        ({"cx": 4000.0}, "principal point .* lies outside the picture"),
        ({"height": "tall"}, "height must be a whole number"),
    ],
)
def test_a_scanner_that_cannot_be_is_refused_by_its_key(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        get_scanner(str(written(tmp_path, **changes)))


def test_a_scenario_finds_the_file_beside_it_and_the_device_has_its_distortion(tmp_path: Path) -> None:
    written(tmp_path, width=1600, height=1000, fx=1800.0, distortion={"scale_error": 0.003, "warp_mm": 0.2})
    demo = (SCENARIO_FOLDER / "s_groove.yaml").read_text()
    plain = demo.replace("  scale_error: -0.002\n  gradient_error_per_m: [0.013, 0.0]\n  warp_mm: 0.1\n", "")
    plain = plain.replace("preset: phoxi_m\n  width: 824\n  height: 616", "preset: mine.yaml")
    (tmp_path / "cell.yaml").write_text(plain)
    config = load_scenario(str(tmp_path / "cell.yaml")).scanner
    assert isinstance(config, RenderedScanner)
    scanner = config.scanner()
    assert (scanner.width, scanner.height) == (824, 515)  # in the shape of the file's sensor
    assert scanner.fx == pytest.approx(1800.0 * 824 / 1600)
    device = config.device(np.random.default_rng(0)).noise
    assert (device.scale_error, device.warp_m) == (0.003, 0.0002)
    assert device.device > 0
    with pytest.raises(InputError, match="There is no scanner file"):
        load_scenario("s_groove", "scanner: !RenderedScanner {preset: none.yaml}")
