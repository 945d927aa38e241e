"""A loading cycle on a plate gives the lines of the tool file, and one that cannot is a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.models.tools.test_tool_file import changed
from tests.worlds.loading import STEPS, LoadingTruth, cycles
from weldcal.models.errors import InputError
from weldcal.models.tools.elastomers import MATERIALS, Elastomer
from weldcal.models.tools.loading import load_tool
from weldcal.tools.cli.app import app


@pytest.fixture(scope="module")
def cycle() -> np.ndarray:
    """Time s, indentation mm, deflection mm and force N (n, 4) of a tip on a contact that gives way."""
    tip = LoadingTruth(
        stiffness=np.array([300.0]), times_s=np.array([[1.6]]), shares=np.array([[0.18]]), loss=np.array([0.25]),
        sliders_m=np.array([[1e-5]]), contact_N_per_m=3000.0,
    )  # fmt: skip
    t, u, x, f = cycles(tip, 0.003, np.array([0.003]), np.array([6.0]), np.array([4.0]))[:, :: STEPS // 400, 0]
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, [[0.008], [0.005]], (2, len(t)))
    return np.column_stack([t, 1e3 * u, 1e3 * x + noise[0], f + noise[1]])


def write(path: Path, header: str, rows: np.ndarray) -> Path:
    """A table as a person records it."""
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.5f")
    return path


def test_a_cycle_gives_the_keys_of_the_tool_file(tmp_path: Path, cycle: np.ndarray) -> None:
    table = write(tmp_path / "cycle.csv", "t_s,indentation_mm,deflection_mm,force_N", cycle)
    done = CliRunner().invoke(app, ["finger", "loading", str(table), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.splitlines()[-1])
    for key, true in (("relaxation_s", 1.6), ("creep_share", 0.18), ("loss_share", 0.25)):
        assert abs(found[key] - true) < 3.0 * found[f"{key}_sigma"] < 0.15 * true
    assert found["stiffness_N_per_mm"] == pytest.approx(0.3, rel=0.02)
    assert found["concerns"] == []
    shown = CliRunner().invoke(app, ["finger", "loading", str(table)]).stdout
    assert "tip: {relaxation_s: 1.6" in shown
    keys = ("relaxation_s", "creep_share", "loss_share")
    tool = load_tool(changed(tmp_path, *((f"tip.{key}", found[key]) for key in keys))).tool
    assert tool.memory == Elastomer(*(found[key] for key in keys))


def test_the_tags_deflection_alone_is_enough(tmp_path: Path, cycle: np.ndarray) -> None:
    table = write(tmp_path / "cycle.csv", "t_s;indentation_mm;deflection_mm", cycle[:, :3])
    table.write_text(table.read_text().replace(",", ";").replace(".", ","))  # as a spreadsheet in Europe writes it
    done = CliRunner().invoke(app, ["finger", "loading", str(table), "--json"])
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["creep_share"] == pytest.approx(0.18, abs=0.01)
    assert "stiffness_N_per_mm" not in found


@pytest.mark.parametrize(
    ("header", "change", "sentence"),
    [
        ("t_s,indentation_mm,deflection", None, "needs the columns t_s, indentation_mm, and force_N, deflection_mm or"),
        ("t_s,indentation_mm,deflection_mm", ("1.50", ""), "deflection_mm is '', not a number"),
    ],
)
def test_a_table_that_cannot_be_used_is_a_sentence(
    tmp_path: Path, cycle: np.ndarray, header: str, change: tuple[str, str] | None, sentence: str
) -> None:
    table = write(tmp_path / "cycle.csv", header, cycle[:, :3])
    if change is not None:
        *rows, last = table.read_text().splitlines()
        table.write_text("\n".join([*rows, last.rpartition(",")[0] + ","]))
    done = CliRunner().invoke(app, ["finger", "loading", str(table)])
    assert done.exit_code == 1
    assert sentence in " ".join(done.output.split())
    assert "Traceback" not in done.output


def test_a_material_gives_what_is_not_stated_and_a_wrong_one_is_a_sentence(tmp_path: Path) -> None:
    tool = load_tool(changed(tmp_path, ("tip.material", "tpu_95a"), ("tip.relaxation_s", 0.5))).tool
    assert tool.memory == Elastomer(0.5, MATERIALS["tpu_95a"].creep_share, MATERIALS["tpu_95a"].loss_share)
    for changes, sentence in (
        ((("tip.material", "pla"),), "tip.material must be one of tpu_85a, tpu_95a, silicone, not 'pla'"),
        ((("tip.loss_share", 0.2),), "tip needs relaxation_s, creep_share, loss_share together, or a material"),
        ((("tip.material", "tpu_85a"), ("tip.creep_share", 20.0)), "tip.creep_share is a share from 0 to 0.6, not 20"),
        ((("tip.material", "tpu_85a"), ("tip.relaxation_s", 0.0)), "tip.relaxation_s must be 0.02 s or more"),
    ):
        with pytest.raises(InputError, match=sentence):
            load_tool(changed(tmp_path, *changes))
