"""Profiles from files: csv with gaps, npy, the unit, and a file that holds no profile."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.systems.drivers.sensors.scripted import wait_until
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Garbage
from weldcal.systems.drivers.sensors.folder_profiler import FolderProfiler, read_profile
from weldcal.systems.drivers.sensors.wired_profiler import acquire_profiles, checked_profile


def test_a_profile_in_a_file_answers_the_request(tmp_path: Path) -> None:
    config = FolderProfiler(folder=str(tmp_path), settle_s=0.02)
    acquisition = acquire_profiles(config, config.source())
    acquisition.start(2.0, first_frame=False)
    try:
        acquisition.request(1)
        time.sleep(0.05)
        x = np.linspace(-20.0, 20.0, 41)
        rows = [f"{v:.3f},{'' if k == 3 else f'{120.0 + k:.3f}'}" for k, v in enumerate(x)]
        (tmp_path / "a.csv").write_text("\n".join(["x,z", *rows]) + "\n")
        assert wait_until(lambda: acquisition.answer(1) is not None)
        found = acquisition.answer(1)
        assert found is not None
        assert found.datum.shape == (41, 2)
        assert np.isnan(found.datum[3]).all()
        assert np.allclose(found.datum[5], [-0.015, 0.125])
        acquisition.request(2)
        time.sleep(0.05)
        np.save(tmp_path / "b.npy", np.column_stack([x, np.full(41, 0.2)]))  # m, and the scenario says mm
        assert wait_until(lambda: acquisition.counts.received + acquisition.counts.garbled == 2)
        found = acquisition.answer(2)
        assert found is not None
        assert np.allclose(found.datum[:, 1], 2e-4)
    finally:
        acquisition.close()


def test_what_is_no_profile_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"'a\.csv' has no columns x and z"):
        read_profile(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("x,z\n1,two\n")
    with pytest.raises(InputError, match=r"'b\.csv' holds words"):
        read_profile(tmp_path / "b.csv")
    with pytest.raises(InputError, match=r"profiler\.unit must be m or mm"):
        FolderProfiler(folder=str(tmp_path), unit="inch").source()


def test_heights_become_distances() -> None:
    heights = np.column_stack([np.linspace(-20.0, 20.0, 41), np.linspace(-30.0, 10.0, 41)])
    with pytest.raises(Garbage, match=r"profiler\.heights_from_mm where z grows towards the sensor"):
        checked_profile(heights, 1e-3, FolderProfiler())
    found = checked_profile(heights, 1e-3, FolderProfiler(heights_from_mm=190.0))
    assert np.allclose(found[[0, -1]], [[-0.02, 0.22], [0.02, 0.18]])
