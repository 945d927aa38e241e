"""`weldcal plan-motion`: larger cubes and leans tell more; a recorded program that shows nothing is said to; nothing is
invented."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner

from weldcal.tools.cli.app import app


def asked(*words: str) -> dict[str, Any]:
    found = CliRunner().invoke(app, ["plan-motion", *words, "--json"])
    assert found.exit_code == 0, found.output
    return dict(json.loads(found.stdout.strip().splitlines()[-1]))


def test_the_best_cube_is_written_as_a_program(tmp_path: Path) -> None:
    said = asked("--seconds", "12", "--out", str(tmp_path / "out"))
    motions = said["motions"]
    assert said["best"] == motions[0]
    assert [m["cost_mm"] for m in motions] == sorted(m["cost_mm"] for m in motions)
    assert len(motions) >= 4
    by_name = {m["name"]: m for m in motions}
    small, large = by_name["cube of 100 mm, lean of 5 deg"], by_name["cube of 200 mm, lean of 5 deg"]
    # twice the lever for centres; the normals tell as much in both
    assert 0.5 < large["rotation_deg"] / small["rotation_deg"] < 0.8
    script = (tmp_path / "out" / "best.script").read_text()
    assert script.count("movej([") == 4
    assert np.allclose(
        np.radians(said["best"]["corners_deg"][0]), json.loads(script.split("movej(")[1].split("]")[0] + "]"), atol=1e-5
    )


def test_recorded_programs_are_compared(tmp_path: Path) -> None:
    t = np.arange(0.0, 8.0, 0.01)
    q = np.array([3.1, -1.2, 2.1, -0.9, 1.6, 0.0])
    wave = 0.15 * np.sin(np.outer(t, 1.3 + 0.3 * np.arange(6)))
    paths = []
    for name, moved in (("still", 0.0 * wave), ("moving", wave)):
        rows = [",".join(f"{v:.6f}" for v in (a, *b)) for a, b in zip(t, q + moved, strict=True)]
        path = tmp_path / f"{name}.csv"
        path.write_text("time,q1,q2,q3,q4,q5,q6\n" + "\n".join(rows) + "\n")
        paths += ["--stream", str(path)]
    said = asked(*paths, "--out", str(tmp_path / "out"))
    moving, still = said["motions"]
    assert moving["name"].endswith("moving.csv")
    assert 0.0 < moving["clock_offset_ms"] < 1.0
    assert still["clock_offset_ms"] is None
    assert not (tmp_path / "out" / "best.script").exists()


def test_a_missing_stream_is_named(tmp_path: Path) -> None:
    found = CliRunner().invoke(
        app, ["plan-motion", "--stream", str(tmp_path / "lost.csv"), "--out", str(tmp_path / "o")]
    )
    assert found.exit_code == 1
    assert "lost.csv" in found.stderr
    assert not (tmp_path / "o").exists()
