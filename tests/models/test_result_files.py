"""A result is complete, absent, or refused: at a full disk, after SIGKILL and SIGTERM at any moment of its writing."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import load_result
from weldcal.models.errors import InputError
from weldcal.models.files import UNFINISHED, require_whole, whole_result, write_atomic, write_npz
from weldcal.tools.commands.doctor import examine
from weldcal.tools.commands.replay import find_pages
from weldcal.welding.record.weld_log import load_weld_log

KILLS = 20
WRITER = """
import json, signal, sys
from pathlib import Path
from weldcal.models.files import whole_result, write_atomic
def end(*_):
    raise KeyboardInterrupt("SIGTERM")
signal.signal(signal.SIGTERM, end)
folder = Path(sys.argv[1])
for number in range(1_000_000):
    with whole_result(folder):
        for name in "abc":
            write_atomic(folder / name, json.dumps({"number": number, "more": "x" * 20000}))
"""


def is_whole(folder: Path) -> bool:
    """Whether readers accept the folder; each file of it must be complete, and all of one result where they do."""
    found = [json.loads((folder / name).read_text())["number"] for name in "abc" if (folder / name).exists()]
    try:
        require_whole(folder)
    except InputError:
        return False
    assert len(found) == 3
    assert len(set(found)) == 1, "files of two results"
    return True


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGTERM])
def test_a_result_is_whole_or_refused_whenever_its_writer_is_ended(kind: signal.Signals, tmp_path: Path) -> None:
    moments, refused = random.Random(4), 0
    for k in range(KILLS):
        folder = tmp_path / str(k)
        pid = os.fork()
        if not pid:  # a child without the start of an interpreter, which so many starts have no time for
            sys.argv = ["", str(folder)]
            try:
                exec(WRITER, {})
            finally:
                os._exit(1)
        until = time.monotonic() + 10.0
        while not (folder / "a").exists() and time.monotonic() < until:
            time.sleep(0.0005)
        time.sleep(moments.uniform(0.0, 0.02))
        os.kill(pid, kind)
        os.waitpid(pid, 0)
        refused += not is_whole(folder)
    assert refused, "some of them died in the middle of a result"


def test_a_full_disk_leaves_the_old_file_and_no_part_of_the_new(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    write_atomic(path, "old")
    script = (
        "import resource, signal, sys\nfrom pathlib import Path\n"
        "from weldcal.models.files import whole_result, write_atomic\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "path = Path(sys.argv[1])\n"
        "with whole_result(path.parent):\n    write_atomic(path, 'n' * 100_000)\n"
    )
    finished = subprocess.run(
        [sys.executable, "-P", "-c", script, str(path)], capture_output=True, text=True, check=False
    )
    assert "File too large" in finished.stderr
    assert path.read_text() == "old"
    assert sorted(file.name for file in tmp_path.iterdir()) == [UNFINISHED, "calibration.yaml"]


def test_a_disk_without_room_is_refused_before_any_work(tmp_path: Path) -> None:
    """The command stops at its folder: nothing is read, so that the missing dataset is not what it names."""

    def little() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    command = [sys.executable, "-P", "-m", "weldcal.tools", "calibrate", "no_such", "--out", str(tmp_path / "new")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=little)
    assert finished.returncode == 1
    assert finished.stderr.startswith("weldcal: Nothing can be written to")
    assert "File too large" in finished.stderr
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_marked_before_the_first_file_and_nothing_stays_after_the_last(tmp_path: Path) -> None:
    with whole_result(tmp_path):
        assert list(tmp_path.iterdir()) == []
        write_npz(tmp_path / "clouds" / "a.npz", points=np.zeros((3, 3)))
        assert (tmp_path / UNFINISHED).exists()
    assert [file.name for file in tmp_path.iterdir()] == ["clouds"]
    with np.load(tmp_path / "clouds" / "a.npz") as found:
        assert found["points"].shape == (3, 3)


def test_a_folder_in_a_folder_marks_both(tmp_path: Path) -> None:
    inner = tmp_path / "scans"
    with whole_result(tmp_path), whole_result(inner):
        write_atomic(inner / "a", "a")
        assert (tmp_path / UNFINISHED).exists()
        assert (inner / UNFINISHED).exists()
    assert [file.name for file in (*tmp_path.iterdir(), *inner.iterdir())] == ["scans", "a"]


def test_an_exception_leaves_the_mark(tmp_path: Path) -> None:
    def write() -> None:
        with whole_result(tmp_path):
            write_atomic(tmp_path / "a", "a")
            (tmp_path / "a").mkdir()

    with pytest.raises(FileExistsError):
        write()
    assert (tmp_path / UNFINISHED).exists()


@pytest.mark.parametrize("read", [load_result, load_dataset, load_weld_log, examine, find_pages])
def test_every_reader_refuses_an_unfinished_result(read: object, tmp_path: Path) -> None:
    for name in ("calibration.yaml", "report.html", "weld.csv", "weld.json", "dataset.yaml", UNFINISHED):
        (tmp_path / name).write_text("{}")
    with pytest.raises(InputError, match="is not complete: weldcal was ended while it wrote it"):
        read(tmp_path)  # type: ignore[operator]
