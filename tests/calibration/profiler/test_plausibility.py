"""What an operator may state or copy wrongly beside a sphere's scans: its radius, a file cut short; and why a model was
taken."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.calibration.profiler.test_cli import called, edge_csv, found
from tests.calibration.profiler.test_sphere import DATA, MM, SIGMAS, clean, needs_data, poses
from tests.worlds.profiler import CLEAN, RADIUS_M, SphereWorld, sphere_trial
from weldcal.calibration.errors import RadiusError
from weldcal.calibration.profiler.sphere.joint import _clearly_less, check_radius, choose_model, free_radius
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.tools.cli.app import app


def some() -> SphereData:
    """Fourteen of the clean scans: fewer show another radius less clearly, and it must be refused all the same."""
    return clean()[1].data.without(*range(14, 20))


def scans_of(data: SphereData, radius_m: float) -> SphereData:
    return SphereData(poses=data.poses, profiles=data.profiles, radius_m=radius_m)


def sphere_file(path: Path, data: SphereData, radius_m: float) -> Path:
    np.savez(
        path, unit="m", rotation=data.poses.rotation, translation=data.poses.translation, profiles=np.array(data.profiles),
        radius=radius_m,
    )  # fmt: skip
    return path


@pytest.mark.parametrize("start", [0.5, 0.8, 1.0, 1.3, 2.0])
def test_the_scans_alone_give_the_radius(start: float) -> None:
    free = free_radius(clean()[1].data, start * RADIUS_M, SIGMAS)
    assert free is not None
    assert free.radius_m == pytest.approx(RADIUS_M, abs=5.0 * free.sigma_m)
    assert free.sigma_m < 0.1e-3


@pytest.mark.parametrize(
    ("factor", "sentence"),
    [
        (2.0, "that is its diameter. Give the radius, 20 mm"),
        (0.5, "that is half of it"),
        (1.3, "Check the radius and the unit"),
    ],
)
def test_a_radius_that_is_another_spheres_is_refused_with_the_one_the_scans_show(factor: float, sentence: str) -> None:
    data = some()
    with pytest.raises(RadiusError, match=rf"show a sphere of (20\.0|19\.9)\d mm radius.*{sentence}"):
        check_radius(scans_of(data, factor * RADIUS_M), SIGMAS, None)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_scanners_scale_error_is_no_other_sphere(factor: float) -> None:
    check_radius(scans_of(some(), factor * RADIUS_M), SIGMAS, None)


@pytest.mark.parametrize("model", ["rigid", "auto"])
def test_the_diameter_for_the_radius_ends_the_command_and_writes_nothing(tmp_path: Path, model: str) -> None:
    d = sphere_trial(SphereWorld.made(5, CLEAN), 505, touches=8, views=0).data
    file = sphere_file(tmp_path / "s.npz", d, 2.0 * d.radius_m)
    code, text = called("sphere", file, "--model", model, "--out", tmp_path / "out")
    assert code == 1, text
    assert "diameter" in text
    assert not (tmp_path / "out").exists()


@needs_data
def test_the_real_spheres_diameter_is_refused_and_its_radius_is_not() -> None:
    z = np.load(DATA / "real_sphere15_a.npz")
    parts = np.split(z["xz"] * MM, np.cumsum(z["n"])[:-1])
    scans = SphereData(poses=poses(z["T_base_flange"]), profiles=[p[::8] for p in parts], radius_m=40 * MM)
    check_radius(scans, SphereSigmas(), None)
    with pytest.raises(RadiusError, match=r"a sphere of 40\.\d\d mm radius.*that is its diameter"):
        check_radius(scans_of(scans, 80 * MM), SphereSigmas(), None)


def test_the_model_taken_is_explained(tmp_path: Path) -> None:
    d = sphere_trial(SphereWorld.made(5, CLEAN), 505, touches=8, views=0).data
    answer = found("sphere", sphere_file(tmp_path / "s.npz", d, d.radius_m), "--out", tmp_path / "out")
    assert answer["model"] == choose_model(scans_of(d, d.radius_m)).model
    for name, value in answer["left_out_rms_mm"].items():
        assert f"{name} {value:.4f} mm" in answer["model_reason"]
    assert "clearly better than rigid" in answer["model_reason"]


def test_clearly_less_is_more_than_one_standard_error_of_paired_differences() -> None:
    a, d = np.array([1.0, 5.0, 9.0, 2.0]), np.array([0.5, -0.5, 0.5, 0.5])
    # mean 0.25, standard error 0.25
    assert not _clearly_less(a, a + d)
    assert _clearly_less(a, a + d + 0.01)
    assert not _clearly_less(a + d + 0.01, a)


@pytest.mark.parametrize(
    ("cut", "said"), [(0, None), (12, "the file is cut off there"), (4, "may be cut off within its last number")]
)
def test_a_csv_cut_off_is_told(tmp_path: Path, cut: int, said: str | None) -> None:
    whole = edge_csv(tmp_path / "whole.csv").read_text()
    rows = whole.splitlines()
    # seven digits: a shorter last number is then seen; 12 characters are its last cell and the comma before it
    fixed = [rows[0], *(",".join(f"{float(v):+011.6f}" for v in row.split(",")) for row in rows[1:])]
    text = "\n".join(fixed) + "\n"
    (tmp_path / "cut.csv").write_text(text if cut == 0 else text[: -1 - cut])
    run = CliRunner().invoke(
        app, ["profiler", "edge", str(tmp_path / "cut.csv"), "--out", str(tmp_path / "out"), "--json"]
    )
    assert run.exit_code == 0, run.output
    answer: dict[str, Any] = json.loads(run.stdout.strip().splitlines()[-1])
    warnings = " ".join(answer.get("warnings", []))
    assert (said in warnings) if said else not warnings
    assert (said in " ".join(run.stderr.split())) if said else True
