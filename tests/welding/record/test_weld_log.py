"""A weld log comes back as it was written; a damaged one is refused with one sentence; every column is documented."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.welding_velocity_servo import PHASE_CODES
from weldcal.tools.report.weld import WeldLog, new_ticks, welds
from weldcal.welding.record.process import WeldProcess
from weldcal.welding.record.weld_log import (
    COLUMNS,
    NAMES,
    WeldLogError,
    WeldRecord,
    heat_summary,
    load_weld_log,
    weld_log_texts,
)
from weldcal.welding.servo.state import Phase

N = 40


def record(process: WeldProcess | None = None) -> WeldRecord:
    rng = np.random.default_rng(3)
    columns = {name: rng.normal(0.0, 0.2, N) for name in NAMES if name != "phase"}
    columns["time_s"] = 4.446 + 0.008 * np.arange(N)
    columns["torch_on"] = (np.arange(N) > 10).astype(float)
    columns["e_t_m"][:5] = np.nan
    arc = process or WeldProcess("MAG", 180.0, 24.0)
    columns["heat_input_J_m"] = arc.heat_input(np.where(columns["torch_on"] > 0.5, 0.008, np.nan))
    phase = np.array(["TOUCH"] * 10 + ["TRACK"] * (N - 10))
    return WeldRecord(columns, phase, arc, {"scenario": "s_groove", "seed": 2, "weld_speed_m_s": 0.008})


@pytest.fixture
def written(tmp_path: Path) -> Path:
    table, header = weld_log_texts(record())
    (tmp_path / "weld.csv").write_text(table)
    (tmp_path / "weld.json").write_text(header)
    return tmp_path


@pytest.mark.parametrize("name", [".", "weld.csv", "weld.json"])
def test_what_was_written_is_read_back(written: Path, name: str) -> None:
    before, after = record(), load_weld_log(written / name)
    assert set(after.columns) == set(before.columns)
    for column, values in before.columns.items():
        # 8 digits: a tenth of a micrometre at a metre, 0.1 ms after an hour.
        assert after[column] == pytest.approx(values, rel=1e-7, nan_ok=True), column
    assert (after.phase == before.phase).all()
    assert (after.process, after.settings) == (before.process, before.settings)
    assert after.torch_on.sum() == N - 11
    assert weld_log_texts(after) == weld_log_texts(load_weld_log(written)), "and again, to the letter"


def test_a_pose_of_the_log_is_a_pose(written: Path) -> None:
    log = load_weld_log(written)
    X_BW = log.pose("BW", 7)
    assert X_BW.translation() == pytest.approx(log.points("p_BW")[7])
    q = np.array([log[f"q_BW_{axis}"][7] for axis in "wxyz"])
    assert abs(X_BW.rotation().ToQuaternion().wxyz() @ q) == pytest.approx(np.linalg.norm(q))


def test_the_header_names_unit_and_frame_of_every_column(written: Path) -> None:
    header = json.loads((written / "weld.json").read_text())
    assert [c["name"] for c in header["columns"]] == (written / "weld.csv").read_text().splitlines()[0].split(",")
    for column in header["columns"]:
        assert column["meaning"]
        for unit, ending in (("m", "_m"), ("s", "_s"), ("rad", "_rad"), ("m/s", "_m_s"), ("J/m", "_J_m")):
            if column["unit"] == unit:
                assert column["name"].endswith(ending)


def change(name: str, edit: Callable[[str], str]) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(edit((folder / name).read_text())) and None


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no header": (lambda f: (f / "weld.json").unlink(), "There is no .*weld.json"),
    "no table": (lambda f: (f / "weld.csv").unlink(), "There is no .*weld.csv"),
    "cut off": (change("weld.csv", lambda t: t[: len(t) // 2]), "cut off or changed"),
    "one number changed": (change("weld.csv", lambda t: t.replace("4.446", "4.447")), "cut off or changed"),
    "binary table": (lambda f: (f / "weld.csv").write_bytes(b"\xff\xfe\x00\x01"), "cannot be read as text"),
    "half a header": (change("weld.json", lambda t: t[:200]), "not complete JSON"),
    "another header": (change("weld.json", lambda _: '{"schema": "cooking"}'), "not the header of a weld log"),
    "a list": (change("weld.json", lambda _: "[1, 2]"), "not the header of a weld log"),
    "from the future": (change("weld.json", lambda t: t.replace('"version": 1', '"version": 9')), "version 9"),
    "no row count": (change("weld.json", lambda t: t.replace('"rows"', '"lines"')), "no usable 'rows'"),
    "wrong row count": (change("weld.json", lambda t: t.replace(f'"rows": {N}', '"rows": 7')), "says 7"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_log_is_refused_in_one_sentence(written: Path, kind: str) -> None:
    damage, said = DAMAGE[kind]
    damage(written)
    with pytest.raises(WeldLogError, match=said) as refusal:
        load_weld_log(written)
    assert isinstance(refusal.value, InputError)
    assert re.search(r"\.$", str(refusal.value))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda t: t.replace("gain", "loss", 1), "lacks the column 'gain'"),
        (lambda t: t.replace("nan", "x", 1), "line 2 has no"),
    ],
)
def test_a_table_with_its_own_checksum_is_still_read_with_care(
    written: Path, edit: Callable[[str], str], said: str
) -> None:
    import hashlib

    table = edit((written / "weld.csv").read_text())
    header = json.loads((written / "weld.json").read_text()) | {"sha256": hashlib.sha256(table.encode()).hexdigest()}
    (written / "weld.csv").write_text(table)
    (written / "weld.json").write_text(json.dumps(header))
    with pytest.raises(WeldLogError, match=said):
        load_weld_log(written)


def test_a_record_that_lacks_a_column_is_not_written() -> None:
    whole = record()
    short = {name: values for name, values in whole.columns.items() if name != "omega_rad_s"}
    with pytest.raises(WeldLogError, match="omega_rad_s"):
        weld_log_texts(WeldRecord(short, whole.phase))


def test_the_heat_is_summed_up_where_it_is_known() -> None:
    summary = heat_summary(record())
    assert summary is not None
    assert summary == pytest.approx((0.432, 0.432))  # 0.8 * 24 V * 180 A / 8 mm/s
    assert heat_summary(record(WeldProcess())) is None
    stood = record()
    on = stood.torch_on
    rows = np.flatnonzero(on)[: on.sum() // 2]
    stood["torch_speed_m_s"][:] = 8e-3
    stood["torch_speed_m_s"][rows] = 1e-6  # half of the time at rest, nearly: the same metal gets twice the heat
    stood["heat_input_J_m"][rows] = 0.8 * 24.0 * 180.0 / 1e-6
    found = heat_summary(stood)
    assert found is not None
    assert found[0] == pytest.approx(0.432 * on.sum() / (on.sum() - len(rows)), rel=0.01)


def test_every_column_is_in_the_document_with_its_unit_and_frame(repository: Path) -> None:
    document = (repository / "docs" / "reference" / "weld_log_columns.md").read_text()
    for c in COLUMNS:
        assert re.search(rf"^\| `{c.name}` \| {re.escape(c.unit) or '-'} \| {c.frame or '-'} \| {re.escape(c.meaning)} \|$", document, re.M), c.name  # fmt: skip


def test_a_row_is_written_once_for_each_tick() -> None:
    ticks = np.array([np.nan, 1.0, 1.008, 1.008, np.nan, 1.016, 0.5, 1.024])
    assert new_ticks(ticks).tolist() == [False, True, True, False, False, True, False, True]


def test_the_rows_of_several_welds_are_told_apart_by_their_touch() -> None:
    phases = [Phase.TOUCH, Phase.TOUCH, Phase.TRACK, Phase.COAST, Phase.TRACK, Phase.FINISH, Phase.TOUCH, Phase.TRACK]
    n, none = len(phases), np.zeros(0)
    codes = np.array([PHASE_CODES[phase] for phase in phases])
    rest = ("p_BTip", "p_BRobot", "R_BT", "p_BW", "p_BTorch", "work", "travel", "deflection_T", "sigma_min")
    log = WeldLog(time=np.arange(n), telemetry={"phase": codes}, torch_on=np.ones(n, bool), **dict.fromkeys(rest, none))
    assert [part.nonzero()[0].tolist() for part in welds(log)] == [[0, 1, 2, 3, 4, 5], [6, 7]]
