"""Damaged files of every format are accepted or refused; the fuzzer itself sees what must not be."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz import damaged_files as cases
from tests.fuzz import run as fuzz
from tests.fuzz.damaged_files import (
    ACCEPTED,
    CRASH,
    GOOD,
    HANG,
    INTERNAL,
    MEMORY,
    READERS,
    REFUSED,
    WRONG,
    Child,
    Reader,
    judge,
    too_much,
)
from weldcal.models.errors import InputError

SLOW = ("scenario",)  # a tenth of a second each


@pytest.mark.parametrize("reader", READERS, ids=lambda r: r.name)
def test_every_example_is_read(reader: Reader, tmp_path: Path) -> None:
    for variant in range(3):
        files = cases._example(READERS.index(reader), 0, variant)
        cases.lay_out(tmp_path / "case", files, reader.target)
        verdict, _ = cases._read(reader, tmp_path / "case")
        assert verdict.said == ACCEPTED, verdict.detail


@pytest.mark.parametrize("reader", READERS, ids=lambda r: r.name)
def test_damaged_files_are_accepted_or_refused(reader: Reader, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    @settings(
        max_examples=5 if reader.name in SLOW else 25,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(seed=st.integers(0, 10**6), case=st.integers(0, 10**6))
    def holds(seed: int, case: int) -> None:
        verdict = judge(reader, seed, case, tmp_path / "case")
        assert verdict.said in GOOD, f"{reader.name} --seed {seed}, case {case}: {verdict.said}\n{verdict.detail}"

    holds()


def one(monkeypatch: pytest.MonkeyPatch, read: object) -> Reader:
    """A reader of the text clouds' files that does something else."""
    reader = Reader("text-cloud", "table", "a.csv", READERS[2].example, read)  # type: ignore[arg-type]
    monkeypatch.setattr(cases, "READERS", (*READERS[:2], reader, *READERS[3:]))
    return reader


def test_a_careless_reader_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def careless(folder: Path) -> list[object]:
        if not (folder / "a.csv").is_file() or (folder / "a.csv").is_symlink():
            raise InputError("There is no such file.")
        lines = (folder / "a.csv").read_text(encoding="latin-1").replace(",", " ").replace(";", " ").splitlines()
        return [[float(v) for v in line.split()[:3]] for line in lines[1:]]

    reader = one(monkeypatch, careless)
    said = {judge(reader, 0, case, tmp_path / "case") for case in range(150)}
    assert {INTERNAL, WRONG, REFUSED} <= {verdict.said for verdict in said}
    reasons = [verdict.detail for verdict in said if verdict.said == WRONG]
    assert any("contradicts itself" in reason for reason in reasons)
    assert any("not finite" in reason for reason in reasons)


def test_the_child_is_watched_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import json, sys, time\n"
        "for line in sys.stdin:\n"
        "    case = int(line.split()[2])\n"
        "    if case == 1: time.sleep(60)\n"
        "    if case == 2: sys.exit(3)\n"
        "    said = 'memory' if case == 3 else 'accepted'\n"
        "    print(json.dumps({'said': said, 'detail': '', 'seconds': 0.1}), flush=True)\n"
    )
    monkeypatch.setattr(cases, "WORKER", ("-c", code))
    with Child(tmp_path / "place") as child:
        assert child.ask(READERS[0], 0, 0)[0].said == ACCEPTED
        monkeypatch.setattr(cases, "WATCHDOG_S", 0.5)
        begin = time.monotonic()
        assert child.ask(READERS[0], 0, 1)[0].said == HANG
        assert time.monotonic() - begin < 5.0
        assert [child.ask(READERS[0], 0, case)[0].said for case in (2, 3, 0)] == [CRASH, MEMORY, ACCEPTED]


def test_a_gigabyte_and_ten_times_the_file_are_allowed() -> None:
    assert not too_much(1024**3 + 10 * 5, 5)
    assert too_much(1024**3 + 10 * 5 + 1, 5)


def test_findings_are_kept_and_end_in_exit_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Child, "ask", lambda self, reader, seed, case: (cases.ReaderVerdict(WRONG, "x"), 0.1))
    result = fuzz.fuzz_files(READERS[:1], 2, 0, tmp_path)
    assert result.summary()["state"] == "failed"
    assert "silently wrong" in str(result.summary()["reason"])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["findings.json", "ply-0", "ply-1"]
    with pytest.raises(InputError, match="There is no reader 'moon'"):
        fuzz.chosen(["moon"])


def test_numbers_that_are_not_finite_are_found_anywhere() -> None:
    assert cases.all_finite([{"a": [1.0]}, None, "x"])
    assert not cases.all_finite([{"a": [float("nan")]}])
