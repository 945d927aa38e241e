"""A result file of each schema version is read; a removed key would be refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from weldcal.calibration.data.results import load_result
from weldcal.calibration.data.stated_pose import read_stated_pose
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.tablet.result import load_tablet_result
from weldcal.models.errors import WeldcalError

KEPT = Path(__file__).with_name("schemas")


def _kept(name: str) -> dict[str, object]:
    return dict(yaml.safe_load((KEPT / name).read_text(encoding="utf-8")))


def test_a_scanner_result_of_schema_1_is_read() -> None:
    result, kept = load_result(KEPT / "calibration.yaml"), _kept("calibration.yaml")
    np.testing.assert_allclose(np.asarray(result.X_BC.GetAsMatrix4()), kept["X_BC"]["matrix"], atol=1e-14)  # type: ignore[index]
    np.testing.assert_array_equal(result.covariance, kept["covariance"]["matrix"])  # type: ignore[index]


def test_a_profiler_result_of_schema_1_is_read() -> None:
    kept = _kept("profiler.yaml")
    matrix = np.array(kept["X_FS"]["matrix"])  # type: ignore[index]
    record = load_record(KEPT / "profiler.yaml")
    np.testing.assert_allclose(record.rotation, matrix[:3, :3], atol=1e-14)
    np.testing.assert_allclose(record.translation, matrix[:3, 3], atol=1e-14)


def test_a_tablet_result_of_schema_1_is_read() -> None:
    np.testing.assert_array_equal(
        load_tablet_result(KEPT / "tablet.yaml").covariance, _kept("tablet.yaml")["covariance"]
    )


def test_a_hand_eye_result_of_schema_1_is_read() -> None:
    kept = _kept("hand_eye.yaml")["poses"]["X_BC"]["matrix"]  # type: ignore[index]
    stated = read_stated_pose(KEPT / "hand_eye.yaml", "X_BC")
    np.testing.assert_allclose(stated.readings[0].X, kept, atol=1e-15)


@pytest.mark.parametrize("read", [load_result, load_record, load_tablet_result])
@pytest.mark.parametrize("version", [0, 2])
def test_another_schema_version_is_refused(read: object, version: int, tmp_path: Path) -> None:
    name = {"load_result": "calibration.yaml", "load_record": "profiler.yaml"}.get(read.__name__, "tablet.yaml")  # type: ignore[attr-defined]
    (tmp_path / name).write_text(yaml.safe_dump({**_kept(name), "schema": version}), encoding="utf-8")
    with pytest.raises(WeldcalError, match=rf"{name}.*(schema|run 'weldcal profiler)"):
        read(tmp_path / name)  # type: ignore[operator]
