"""A bead measured in raw profiles against a generator that shares no model with it, and along a seam."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.profiler.test_cli import called, found
from tests.worlds.bead import TOE_M, Section, Sensor, profile, seam, sections
from weldcal.calibration.errors import FeatureNotFound, InconsistentData
from weldcal.calibration.profiler.features.bead import bead_features
from weldcal.calibration.profiler.features.bead_course import bead_course
from weldcal.calibration.profiler.record import ProfilerRecord, save_record
from weldcal.models.errors import InputError

WITHIN = 1.3  # of the stated sigma
LIMITS = np.array([0.1e-3, 0.1e-3, 0.03])  # of width, height, and of the area its share
Floats = np.ndarray[Any, np.dtype[np.float64]]


def measured(count: int, seed: int, sensor: Sensor | None = None, **plate: float) -> tuple[Floats, Floats, Floats]:
    """True values, errors and sigmas (count, 3) of beads of other shapes."""
    rng = np.random.default_rng(seed)
    true, error, sigma = [], [], []
    for section in sections(count, rng):
        f = bead_features(profile(section, rng, sensor, **plate))
        true.append(section.true(TOE_M, plate.get("corner", 0.0)))
        error.append(f.values - true[-1])
        sigma.append(f.sigmas)
    return np.array(true), np.array(error), np.array(sigma)


def right(error: Floats, sigma: Floats) -> bool:
    """Whether errors are as large as their sigmas say."""
    ratio = np.sqrt(np.mean((error / sigma) ** 2, axis=0))
    return bool(((ratio > 1.0 / WITHIN) & (ratio < WITHIN)).all())


def accurate(true: Floats, error: Floats) -> bool:
    """Whether the rms errors are within the limits."""
    return bool((np.sqrt(np.mean(error**2, axis=0)) < LIMITS * [1.0, 1.0, true[:, 2].mean()]).all())


def test_a_hundred_beads_with_spatter_are_measured_and_their_sigmas_right() -> None:
    true, error, sigma = measured(100, 8)
    assert accurate(true, error)
    assert np.abs(error).max(axis=0) == pytest.approx([0, 0, 0], abs=0.6e-3)
    assert right(error, sigma)
    for k in range(3):
        for factor in (1.0 / 1.5, 1.5):
            assert not right(error, sigma * np.where(np.arange(3) == k, factor, 1.0)), "the test sees a wrong sigma"


@pytest.mark.parametrize(
    ("sensor", "plate"),
    [
        (Sensor(noise_m=0.1e-3), {}),
        (Sensor(smooth=4, spikes=0.0), {}),
        (Sensor(balls=0.0, spikes=0.0), {"bend_m": -0.5}),
        (Sensor(), {"bend_m": 1e9, "corner": 0.25}),
        (Sensor(spikes=0.0), {"bend_m": 1e9, "corner": -0.1}),
    ],
    ids=["more noise", "noise that neighbours share", "hollow plate", "fillet", "roof"],
)
def test_other_sensors_and_plates(sensor: Sensor, plate: dict[str, float]) -> None:
    true, error, sigma = measured(40, 3, sensor, **plate)
    limit = 2.0 if sensor.noise_m > 0.05e-3 or sensor.smooth > 1 else 1.0
    assert accurate(true, error / limit)
    ratio = 1.4826 * np.median(np.abs(error / sigma), axis=0)
    assert (ratio < 1.5).all()
    assert (ratio > 0.5).all()


def test_a_turned_profile_has_the_same_bead() -> None:
    rng = np.random.default_rng(4)
    p = profile(Section(), rng, Sensor(balls=0.0, spikes=0.0, dropped=0.0))
    f = bead_features(p)
    c, s = np.cos(0.2), np.sin(0.2)
    turned = bead_features(p @ [[c, s], [-s, c]])
    assert np.abs(turned.values - f.values) == pytest.approx(np.zeros(3), abs=5e-6)
    assert np.linalg.norm(f.points[1] - f.points[0]) == pytest.approx(f.values[0], rel=1e-3)
    assert np.linalg.norm(f.points[2] - f.points[3]) == pytest.approx(f.values[1], rel=1e-6)
    assert f.points[2, 1] < f.points[3, 1], "the crown is nearer to the sensor"


def plate_only() -> Floats:
    return profile(Section(height_m=1e-6), np.random.default_rng(1))


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        (plate_only(), "no bead"),
        (profile(Section(), np.random.default_rng(1)) * [1.0, -1.0], "no bead"),
        (profile(Section(halves_m=(2e-2, 2e-2)), np.random.default_rng(1)), "bead"),
        (profile(Section(), np.random.default_rng(1))[:50], "returns only"),
    ],
    ids=["plate", "groove", "no plate", "few"],
)
def test_a_profile_without_a_bead_is_refused(shown: Floats, words: str) -> None:
    with pytest.raises(FeatureNotFound, match=words):
        bead_features(shown)


def test_an_array_that_is_no_profile_is_refused() -> None:
    with pytest.raises(InputError, match="array"):
        bead_features(np.zeros(7))


X_FS = np.eye(4)
X_FS[:3, :3] = Rotation.from_euler("xyz", [170.0, -9.0, 52.0], degrees=True).as_matrix()
X_FS[:3, 3] = [0.055, 0.021, 0.13]


def scanned(
    folder: Path, changed: dict[int, float], grows: float = 1.0, sensor: Sensor | None = None
) -> tuple[Any, Floats]:
    """A seam of 60 profiles as bead.npz and its calibration as cal; the seam and the table that is written of it."""
    made = seam(60, np.random.default_rng(5), changed, sensor)
    cal = ProfilerRecord(method="joint", rotation=X_FS[:3, :3], translation=X_FS[:3, 3])
    (folder / "cal").mkdir()
    save_record(cal, folder / "cal")
    profiles = np.array(made.profiles) * [1.0, grows]
    np.savez(folder / "bead.npz", T=made.X_BS @ np.linalg.inv(X_FS), profiles=profiles, unit="m")
    return made, profiles


def test_along_a_seam_the_oblique_sections_are_turned_across_it(tmp_path: Path) -> None:
    made, _ = scanned(tmp_path, {20: 1.2, 21: 1.2, 40: 0.01})
    answer = found("bead", tmp_path / "bead.npz", "--calibration", tmp_path / "cal", "--out", tmp_path / "out")
    assert answer["without_bead"] == [40]
    assert {20, 21} <= set(answer["unlike_profiles"])
    assert len(answer["unlike_profiles"]) <= 5
    table = np.genfromtxt(tmp_path / "out/bead.csv", delimiter=",", names=True)
    at = table["scan"].astype(int)
    assert np.diff(table["station_mm"]) == pytest.approx(1e3 * np.diff(made.station_m[at]), abs=1.5)
    true = made.true[at] * [1e3, 1e3, 1e6]
    ours = np.column_stack([table[k] for k in ("width_mm", "height_mm", "area_mm2")])
    assert np.median(np.abs(ours - true), axis=0) == pytest.approx([0, 0, 0], abs=0.15)
    length = 1e3 * (np.ptp(made.station_m) - made.station_m[41] + made.station_m[39])
    assert answer["length_mm"] == pytest.approx(length, rel=0.02)
    assert answer["volume_mm3"] / answer["length_mm"] == pytest.approx(true[:, 2].mean(), rel=0.02)
    assert answer["width_mm"]["left_out_rms"] < 0.3
    assert answer["height_mm"]["largest_at"] == pytest.approx(41.0, abs=2.0)
    assert "unlike their neighbours" in (tmp_path / "out/report.html").read_text()


def test_poses_whose_travel_is_along_the_profiles_are_refused() -> None:
    k = np.arange(12)[:, None, None] * 3e-3
    section = np.array([[-4e-3, 0.0, 0.0], [4e-3, 0.0, 0.0], [0.0, 0.0, 2e-3], [0.0, 0.0, 0.0]])
    values, sigmas = np.tile([8e-3, 2e-3, 1e-5], (12, 1)), np.full((12, 3), 1e-5)
    number = np.arange(12)
    right = bead_course(values, sigmas, number, section + k * [0.0, 1.0, 0.0])
    assert right.values == pytest.approx(values)
    aslant = bead_course(values, sigmas, number, section + k * [np.sin(1.0), np.cos(1.0), 0.0])
    assert aslant.values[:, 0] == pytest.approx(8e-3 * np.cos(1.0))
    with pytest.raises(InconsistentData, match="along the travel of their poses"):
        bead_course(values, sigmas, number, section + k * [1.0, 0.1, 0.0])


def test_spatter_at_a_toe_is_named_by_its_neighbours(tmp_path: Path) -> None:
    made, _ = scanned(tmp_path, {}, sensor=Sensor(balls=3.0, anywhere=True))
    answer = found("bead", tmp_path / "bead.npz", "--calibration", tmp_path / "cal", "--out", tmp_path / "out")
    table = np.genfromtxt(tmp_path / "out/bead.csv", delimiter=",", names=True)
    at = table["scan"].astype(int)
    off = np.abs(table["width_mm"] - 1e3 * made.true[at, 0])
    assert set(at[off > 0.8]) <= set(answer["unlike_profiles"])
    assert np.median(off) < 0.1


def test_heights_and_profiles_without_poses_are_measured_by_their_number(tmp_path: Path) -> None:
    _, profiles = scanned(tmp_path, {}, grows=-1.0)
    np.savez(tmp_path / "alone.npz", profiles=1e3 * profiles, unit="mm")
    answer = found("bead", tmp_path / "alone.npz", "--out", tmp_path / "out")
    assert answer["z_grows"] == "towards the sensor"
    assert answer["found"] == 60
    assert "volume_mm3" not in answer
    code, text = called("bead", tmp_path / "alone.npz", "--limit-mm", "0.01", "--out", tmp_path / "missed")
    assert code == 1
    assert "above the tolerance of 0.010 mm" in text
    _, text = called("bead", tmp_path / "alone.npz", "--out", tmp_path / "again")
    assert "No --calibration: the values are by profile number" in text
    code, text = called("bead", tmp_path / "alone.npz", "--calibration", tmp_path / "cal", "--out", tmp_path / "none")
    assert code == 1
    assert "no flange poses" in text
    code, text = called("bead", tmp_path / "alone.npz", "--toe-mm", "0", "--out", tmp_path / "none")
    assert code == 2
    assert "greater than or equal to 0.01" in text


def test_few_profiles_do_not_predict_each_other(tmp_path: Path) -> None:
    made = seam(2, np.random.default_rng(0))
    np.savez(tmp_path / "two.npz", profiles=np.array(made.profiles), unit="m")
    answer = found("bead", tmp_path / "two.npz", "--out", tmp_path / "out")
    assert answer["width_mm"]["left_out_rms"] is None
    assert "neighbours of 2 profiles: not known" in answer["first_screen"]["backing"]
