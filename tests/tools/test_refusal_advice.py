"""Refusals of `calibrate` name the doctor's first cause, and their advice, followed literally, leads to a
calibration."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.documents.scans import write_scans
from weldcal.tools.cli.app import app

Row = dict[str, str]


def written(folder: Path, change: Callable[[Row], list[str]]) -> Path:
    """Scans of a flange without a guess of the scanner, the poses changed."""
    write_scans(folder, 10, 0)
    table, header = folder / "poses.csv", folder / "dataset.yaml"
    rows = list(csv.DictReader(table.open()))
    table.write_text("\n".join(["id,x,y,z,qw,qx,qy,qz", *(",".join(change(row)) for row in rows)]) + "\n")
    text = header.read_text()
    header.write_text(text[: text.index("scanner_guess")] + text[text.index("schema:") :])
    return folder


def with_tcp(row: Row) -> list[str]:
    q = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
    p = np.array([float(row[k]) for k in "xyz"]) + q.apply([0.02, 0.01, 0.15])
    return [row["id"], *(f"{v:.9f}" for v in p), row["qw"], row["qx"], row["qy"], row["qz"]]


def other_order(row: Row) -> list[str]:
    return [row[k] for k in ("id", "x", "y", "z", "qx", "qy", "qz", "qw")]


def asked(*words: object) -> tuple[str, dict[str, object]]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.output, json.loads(done.stdout.splitlines()[-1])


def follow(folder: Path, advice: str) -> None:
    header = folder / "dataset.yaml"
    assert "poses: null" in header.read_text()
    header.write_text(header.read_text().replace("poses: null", advice))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (with_tcp, r"a TCP of \(20\.0, 10\.0, 150\.0\) mm"),
        (other_order, r"without it to [5-9]\d\.\d \(median\); the centres fit to 0\.\d\d mm either way"),
    ],
)
def test_the_advice_of_a_refusal_leads_to_the_calibration(
    tmp_path: Path, change: Callable[[Row], list[str]], said: str
) -> None:
    folder = written(tmp_path / "scans", change)
    _, refused = asked("calibrate", folder, "--out", tmp_path / "out", "--json")
    reason = str(refused["reason"])
    assert re.search(said, reason), reason
    advice = re.search(r"poses: \{[^}]*\}", reason)
    assert advice is not None
    _, doctor = asked("doctor", folder, "--json")
    assert advice[0] in json.dumps(doctor), "doctor and calibrate give one remedy"
    follow(folder, advice[0])
    _, done = asked("calibrate", folder, "--out", tmp_path / "out", "--json")
    X = np.array(done["X_BC"])
    assert 1e3 * np.linalg.norm(X[:3, 3] - [0.66, 0.02, 0.94]) < 0.5


@pytest.mark.parametrize("order", ["yxz", "zyx", "xzy"])
def test_a_header_that_exchanges_two_positions_is_named(tmp_path: Path, order: str) -> None:
    folder = written(tmp_path / "scans", lambda row: [row[k] for k in ("id", "x", "y", "z", "qw", "qx", "qy", "qz")])
    table = folder / "poses.csv"
    text = table.read_text()
    table.write_text(text.replace("id,x,y,z", f"id,{','.join(order)}"))
    _, refused = asked("calibrate", folder, "--out", tmp_path / "out", "--json")
    first, second = [axis for axis, place in zip("xyz", order, strict=True) if axis != place]
    reason = str(refused["reason"])
    assert f"the columns {first} and {second} of the poses are exchanged" in reason
    assert "Name the columns in the header" in reason
    table.write_text(text)
    _, done = asked("calibrate", folder, "--out", tmp_path / "out", "--json", "--overwrite")
    assert done["state"] == "done"
