"""Ctrl-C and SIGTERM at any moment: one sentence, an exit code of the table, no traceback, no process left."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import typer

from tests.interrupted import KNOWN, QUICK, commands, end_after
from tests.worlds.doctor import write_cell
from weldcal.models.files import UNFINISHED, whole_result, write_atomic
from weldcal.tools import console

RNG = random.Random(7)
MOMENTS = [
    ("demo", signal.SIGINT, 0.6),
    ("demo, page", signal.SIGTERM, 4.0),
    ("weld", signal.SIGINT, RNG.uniform(2.0, 8.0)),
    ("calibrate live", signal.SIGTERM, RNG.uniform(2.0, 8.0)),
    ("calibrate recorded", signal.SIGINT, RNG.uniform(0.5, 4.0)),
]


@pytest.mark.parametrize(
    ("name", "number", "after_s"), MOMENTS, ids=lambda value: value if isinstance(value, str) else None
)
def test_a_signal_leaves_one_sentence_and_nothing_else(
    name: str, number: signal.Signals, after_s: float, tmp_path: Path
) -> None:
    moves, scenario, dataset = (tmp_path / name for name in ("moves.yaml", "short.yaml", "dataset"))
    moves.write_text(QUICK + KNOWN)
    scenario.write_text(QUICK)
    write_cell(dataset, "fine", 1, np.random.default_rng(0))
    ended = end_after(commands(next(dataset.glob("*/")), moves, scenario)[name], after_s, number, tmp_path / "out")
    assert ended.faults == [], ended.err


def python(body: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script that has installed the handlers."""
    begin = "import os, signal, sys, time\nfrom weldcal.systems import interrupts\ninterrupts.answer_signals()\n"
    command = [sys.executable, "-c", begin + textwrap.dedent(body), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_a_signal_while_python_runs_a_text_keeps_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "ends.py").write_text(
        "import sys\nfrom weldcal.systems.interrupts import ignore_signals\n"
        "try:\n    exec('raise KeyboardInterrupt')\nexcept KeyboardInterrupt:\n    pass\n"
        "ignore_signals()\nsys.exit(7)\n"
    )
    assert subprocess.run([sys.executable, "-m", "ends"], cwd=tmp_path, check=False).returncode == 7


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_before_the_work_begins_nothing_was_written(number: str) -> None:
    ended = python(f"os.kill(os.getpid(), signal.{number}); print('goes on')", "--json")
    assert ended.returncode == 130
    assert ended.stderr.startswith("weldcal: Ctrl-C or SIGTERM ended the command before it began")
    assert json.loads(ended.stdout)["state"] == "failed"


def test_a_deferred_signal_comes_at_the_end_of_the_block() -> None:
    ended = python("""
        with interrupts.work():
            try:
                with interrupts.deferred():
                    os.kill(os.getpid(), signal.SIGTERM)
                    os.kill(os.getpid(), signal.SIGINT)
                    print("still here")
                time.sleep(5.0)
            except KeyboardInterrupt:
                print("then")
    """)
    assert ended.stdout.split() == ["still", "here", "then"]


def test_a_started_process_gets_no_ctrl_c() -> None:
    ended = python("""
        child = interrupts.started([sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(1.0); print('whole')"])
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        print(child.wait())
    """)
    assert ended.stdout.split()[-2:] == ["whole", "0"]
    assert "Traceback" not in ended.stderr


def test_an_interrupt_in_a_destructor_is_not_lost() -> None:
    ended = python("""
        class Held:
            def __del__(self):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.01)
        with interrupts.work():
            try:
                held = Held()
                del held
                time.sleep(5.0)
                print("lost")
            except KeyboardInterrupt:
                print("raised")
    """)
    assert ended.stdout.split() == ["raised"], ended.stderr
    assert ended.stderr == ""


def test_after_the_outcome_a_signal_changes_nothing() -> None:
    ended = python("""
        with interrupts.work():
            pass
        os.kill(os.getpid(), signal.SIGINT)
        print("the outcome")
        interrupts.ignore_signals()
    """)
    assert (ended.returncode, ended.stdout.strip(), ended.stderr) == (0, "the outcome", "")


def test_the_sentence_names_the_unfinished_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def half_a_result() -> None:
        with console.boundary(json_wanted=True, debug=False), whole_result(tmp_path):
            write_atomic(tmp_path / "report.html", "half")
            raise KeyboardInterrupt

    with pytest.raises(typer.Exit) as end:
        half_a_result()
    assert end.value.exit_code == 130
    assert (tmp_path / UNFINISHED).exists()
    said = capsys.readouterr()
    assert f"'{tmp_path}' is not complete (UNFINISHED)" in said.err
    assert json.loads(said.out)["reason"] == said.err.removeprefix("weldcal: ").strip()
