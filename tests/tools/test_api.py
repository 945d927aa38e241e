"""The functions of `import weldcal`; the examples of docs/python.md run in tests/documents."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from typer.testing import CliRunner

import weldcal
from tests.documents.scans import write_scans
from weldcal.calibration.data.checks import metric_cloud
from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.header import DatasetHeader, Units
from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.cell.new import write_example


def test_pairs_of_poses_give_the_camera() -> None:
    rng = np.random.default_rng(0)
    X, Y = (RigidTransform(RollPitchYaw(rng.uniform(-1.0, 1.0, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in "XY")
    robot = [RigidTransform(RollPitchYaw(rng.uniform(-0.6, 0.6, 3)), rng.uniform(-0.5, 0.5, 3)) for _ in range(12)]
    camera = np.array([(F @ X).InvertAndCompose(Y).GetAsMatrix4() for F in robot])
    found = weldcal.hand_eye(np.array([F.GetAsMatrix4() for F in robot]), camera).poses["X"]
    assert found.GetAsMatrix4() == pytest.approx(X.GetAsMatrix4(), abs=1e-6)


def test_nothing_is_kept_where_no_folder_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_scans(tmp_path / "my_scans", 8, 0)
    before = sorted(tmp_path.rglob("*"))
    found = weldcal.calibrate("my_scans", correct_scanner=False)
    assert found.estimate.inliers.sum() >= 4
    assert sorted(tmp_path.rglob("*")) == before


def test_importing_weldcal_loads_nothing_else_and_shows_its_functions() -> None:
    script = (
        "import sys, weldcal; assert 'pydrake' not in sys.modules; print(*[n for n in dir(weldcal) if n in"
        " weldcal.__all__])"
    )
    finished = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.split() == sorted(weldcal.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        weldcal.calibrat  # type: ignore[attr-defined]  # noqa: B018


def test_weldcal_states_its_installed_version() -> None:
    assert weldcal.__version__ == version("weldcal")


@pytest.mark.parametrize("shape", [(4, 4), (3, 3, 4), (2, 4, 4)])
def test_poses_of_another_shape_are_refused_in_a_sentence(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"robot and camera must both be \(n, 4, 4\) matrices"):
        weldcal.hand_eye(np.zeros(shape), np.zeros((3, 4, 4)))


def test_an_example_is_not_written_over_something(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty: choose another folder"):
        write_example(tmp_path)


def test_a_cell_shows_its_plant_its_viewer_and_its_named_logs() -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))
    cell = weldcal.build_cell("straight_groove", meshcat=meshcat)
    try:
        assert cell.plant is not None
        assert cell.plant.is_finalized()
        assert cell.plant.GetMyContextFromRoot(cell.diagram.CreateDefaultContext()).num_continuous_states() >= 0
        assert cell.scene_graph is not None
        assert cell.diagram.HasSubsystemNamed("meshcat_visualizer")
        assert cell.logs
        assert all(cell.diagram.GetSubsystemByName(f"log_{name}") is sink for name, sink in cell.logs.items())
    finally:
        cell.station.close()


def test_read_cloud_finds_the_unit_as_calibrate_and_apply_do(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    metres = rng.uniform([-0.1, -0.1, 0.55], [0.1, 0.1, 0.65], (300, 3))
    save_result(
        CalibrationResult(X_BC=RigidTransform(), covariance=np.eye(6), held_out_mm={}, tilt_deg={}, poses=()), tmp_path
    )
    for unit, factor in (("mm", 1e3), ("m", 1.0)):
        path = tmp_path / f"in_{unit}.ply"
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(factor * metres))
        assert o3d.io.write_point_cloud(path, cloud)
        assert weldcal.read_cloud(path) == pytest.approx(metres, abs=1e-6)
        assert weldcal.read_cloud(path, "m") == pytest.approx(factor * metres, rel=1e-6)
        words = ["apply", str(tmp_path), str(path), str(tmp_path / f"out_{unit}.npy"), "--json"]
        assert json.loads(CliRunner().invoke(app, words).stdout.splitlines()[-1])["unit"] == unit
        header = DatasetHeader(units=Units("auto", "auto"))
        assert metric_cloud(path, header, tmp_path) == pytest.approx(metres, abs=1e-6)
    far = tmp_path / "far.npy"
    np.save(far, 1e6 * metres)
    with pytest.raises(CloudError, match=r"far\.npy lie 6.* neither m nor mm"):
        weldcal.read_cloud(far)
    with pytest.raises(InputError, match="must be auto, m or mm, not 'inch'"):
        weldcal.read_cloud(far, "inch")
