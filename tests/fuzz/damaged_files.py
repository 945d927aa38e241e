"""Reads damaged files with every reader, in a child process that is started anew after it hung, died or grew.

As a program of its own this module is the child: it reads "reader seed case" lines and answers each with a line of
JSON.
"""

import json
import os
import pickle
import resource
import selectors
import shutil
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.yaml import yaml_dump_typed

from tests.fuzz import file_examples as examples
from tests.fuzz import scan_examples
from tests.fuzz.damage import GRAMMARS
from tests.fuzz.file_examples import Files, Rng
from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import load_result
from weldcal.calibration.hand_eye.pairs.files import read_pairs
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.tablet.planar_files import load_planar
from weldcal.calibration.tablet.result import load_tablet_result
from weldcal.calibration.tablet.wrist.files import load_visit
from weldcal.models.arms.kinematics import load_arm
from weldcal.models.array_files import read_grey_image
from weldcal.models.errors import InputError
from weldcal.systems.scenario.loading import load_scenario, scenario_class
from weldcal.tools.commands.profiler.files import read_profiler_file
from weldcal.welding.record.weld_log import load_weld_log

ACCEPTED, REFUSED, INTERNAL, WRONG = "accepted", "refused", "internal error", "silently wrong"
HANG, MEMORY, CRASH, EXECUTED = "hang", "memory", "crash", "executed"
GOOD = (ACCEPTED, REFUSED)
_PLACES = ("a pipe", "a folder", "a device", "a loop of links", "nothing")
_ODD_PLACE = 0.02  # share of the cases in which no regular file is there
_MAY_BE_MISSING = (
    "dataset",
    "hand-eye-folder",
)  # a folder without dataset.yaml, or without one of its samples, is right
_UNITS = 0.05  # and in which a dataset's unit is exchanged
_EXAMPLES = 40  # different ones of each reader
_LONGEST = 1010  # characters of a refusal


Values = Sequence[Any]


@dataclass(frozen=True)
class Reader:
    """A reader: ``target`` is the file of the example that is damaged, by the grammar ``kind``.

    ``read`` takes the folder and returns what was read, all numbers of which must be finite where ``finite``.
    """

    name: str
    kind: str
    target: str
    example: Callable[[Rng], Files]
    read: Callable[[Path], Values]
    finite: bool = True


def _dataset(folder: Path) -> Values:
    data = load_dataset(folder)
    if data.refused:
        raise InputError(data.refused[0][1])
    poses = [X.GetAsMatrix34() for X in data.poses.values()]
    guesses = [None if (X := data.guess(id)) is None else X.GetAsMatrix34() for id in data.poses]
    centres = [v for p in data.pairs for v in (p.X_BR.GetAsMatrix34(), p.p_CR)]
    return [asdict(data.header), *poses, *guesses, *centres, *(data.cloud(id) for id in data.clouds)]


def _pairs(name: str) -> Callable[[Path], Values]:
    def read(folder: Path) -> Values:
        p = read_pairs(folder / name, mounting="eye_in_hand")
        return [p.robot, p.camera, p.robot2, p.link, p.mode, p.X_true, p.q]

    return read


def _cloud(name: str) -> Callable[[Path], Values]:
    return lambda folder: [read_cloud(folder / name)]


def _profiler(name: str) -> Callable[[Path], Values]:
    def read(folder: Path) -> Values:
        file = read_profiler_file(folder / name)
        X = file.poses()
        return [file.arrays, *(file.profiles or ()), None if X is None else (X.rotation, X.translation)]

    return read


def _calibration(folder: Path) -> Values:
    r = load_result(folder)
    return [r.X_BC.GetAsMatrix34(), {**vars(r), "X_BC": None, "held_out_mm": None}, list(r.held_out_mm)]


def _record(folder: Path) -> Values:
    r = load_record(folder)
    return [{**vars(r), "arm": None if r.arm is None else r.arm.rows, "figures": str(r.figures)}]


def _tablet_record(folder: Path) -> Values:
    r = load_tablet_result(folder)
    return [None if r.X_FC is None else r.X_FC.GetAsMatrix34(), {**vars(r), "X_FC": None}]


def _visit(folder: Path) -> Values:
    v = load_visit(folder / "touches.csv", folder / "poses.csv", folder / "camera.yaml", seen=folder / "seen.csv")
    poses = [X.GetAsMatrix34() for X in (*v.data.X_BF, v.data.views[0][0])]
    return [*poses, v.data.touched_m, v.data.landmark_m, v.data.views[0][1], v.names]


def _planar(folder: Path) -> Values:
    return [value for v in load_planar(folder / "a.npz").visits for value in (vars(v.touches), v.rows)]


def _scenario(folder: Path) -> Values:
    return [yaml_dump_typed(load_scenario(str(folder / "cell.yaml")), schema=scenario_class())]


def _weld_log(folder: Path) -> Values:
    log = load_weld_log(folder)
    return [dict(log.columns), list(log.phase), vars(log.process)]


READERS = (
    Reader("ply", "cloud", "a.ply", examples.ply, _cloud("a.ply")),
    Reader("pcd", "cloud", "a.pcd", examples.pcd, _cloud("a.pcd"), finite=False),
    Reader("text-cloud", "table", "a.csv", examples.text_cloud, _cloud("a.csv")),
    Reader("npz-cloud", "npz", "a.npz", examples.npz_cloud, _cloud("a.npz"), finite=False),
    Reader("npy-cloud", "npy", "a.npy", examples.npy_cloud, _cloud("a.npy")),
    Reader("dataset", "yaml", "dataset.yaml", examples.dataset, _dataset),
    Reader("poses", "table", "poses.csv", examples.dataset, _dataset),
    Reader("pairs", "table", "pairs.csv", examples.pairs, _dataset),
    Reader("calibration", "yaml", "calibration.yaml", examples.calibration, _calibration),
    Reader("hand-eye-npz", "npz", "pairs.npz", examples.hand_eye_npz, _pairs("pairs.npz")),
    Reader("hand-eye-csv", "table", "pairs.csv", examples.hand_eye_csv, _pairs("pairs.csv")),
    Reader("hand-eye-json", "json", "pairs.json", examples.hand_eye_json, _pairs("pairs.json")),
    Reader("hand-eye-yaml", "yaml", "pairs.yaml", examples.hand_eye_yaml, _pairs("pairs.yaml")),
    Reader("profiler-npz", "npz", "a.npz", examples.profiler_npz, _profiler("a.npz"), finite=False),
    Reader("profiler-csv", "table", "a.csv", examples.profiler_csv, _profiler("a.csv"), finite=False),
    Reader("profiler-gocator", "table", "a.csv", examples.profiler_gocator, _profiler("a.csv"), finite=False),
    Reader("profiler-blocks", "table", "a.csv", examples.profiler_blocks, _profiler("a.csv"), finite=False),
    Reader("profiler-heights", "table", "a.csv", examples.profiler_heights, _profiler("a.csv"), finite=False),
    Reader("profiler-poses", "table", "poses.csv", examples.profiler_gocator, _profiler("a.csv"), finite=False),
    Reader("profiler-record", "yaml", "profiler.yaml", examples.profiler_record, _record),
    Reader("touches", "table", "touches.csv", examples.tablet, _visit),
    Reader("tablet-poses", "table", "poses.csv", examples.tablet, _visit),
    Reader("seen", "table", "seen.csv", examples.tablet, _visit),
    Reader("camera", "yaml", "camera.yaml", examples.tablet, _visit),
    Reader("planar", "npz", "a.npz", examples.planar, _planar),
    Reader("tablet-record", "yaml", "tablet.yaml", examples.tablet_record, _tablet_record),
    Reader("scenario", "yaml", "cell.yaml", examples.scenario, _scenario),
    Reader(
        "kinematics",
        "yaml",
        "kinematics.yaml",
        examples.kinematics,
        lambda f: [load_arm(kinematics=f / "kinematics.yaml").stack],
    ),
    Reader("weld-table", "table", "weld.csv", examples.weld_log, _weld_log, finite=False),
    Reader("weld-header", "json", "weld.json", examples.weld_log, _weld_log, finite=False),
    Reader("image", "image", "a.png", examples.image, lambda f: [read_grey_image(f / "a.png")]),
    Reader("hand-eye-program", "text", "set/robot.txt", scan_examples.program, _pairs("set")),
    Reader("hand-eye-captions", "text", "poses.txt", scan_examples.captions, _pairs("poses.txt")),
    Reader("hand-eye-documents", "text", "set/robot.yaml", scan_examples.documents, _pairs("set")),
    Reader("hand-eye-nested", "json", "pairs.json", scan_examples.nested, _pairs("pairs.json")),
    Reader("hand-eye-matlab", "matlab", "pairs.mat", scan_examples.matlab, _pairs("pairs.mat")),
    Reader("hand-eye-folder", "json", "set/sample_3.json", scan_examples.folder, _pairs("set")),
    Reader("ply-grid", "cloud", "a.ply", scan_examples.ply_grid, _cloud("a.ply"), finite=False),
    Reader("ply-lists", "cloud", "a.ply", scan_examples.ply_lists, _cloud("a.ply"), finite=False),
    Reader("ply-gz", "bytes", "a.ply.gz", scan_examples.ply_gz, _cloud("a.ply.gz"), finite=False),
    Reader("pcd-stored", "cloud", "a.pcd", scan_examples.pcd_stored, _cloud("a.pcd"), finite=False),
    Reader("pts", "table", "a.pts", scan_examples.pts, _cloud("a.pts"), finite=False),
    Reader("depth-png", "image", "clouds/s0.png", scan_examples.depth_png, _dataset, finite=False),
    Reader("depth-tiff", "bytes", "clouds/s0.tif", scan_examples.depth_tiff, _dataset, finite=False),
    Reader("depth-npy", "npy", "clouds/s0.npy", scan_examples.depth_npy, _dataset, finite=False),
    Reader("intrinsics", "yaml", "camera_info.yaml", scan_examples.depth_npy, _dataset, finite=False),
)


def all_finite(value: Any) -> bool:
    """Return whether all numbers of what was read are finite."""
    if isinstance(value, dict):
        return all(all_finite(v) for v in value.values())
    if isinstance(value, list | tuple):
        return all(all_finite(v) for v in value)
    if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
        return bool(np.isfinite(value).all())
    return True


@dataclass(frozen=True)
class ReaderVerdict:
    """What a reader did with a case, and its sentence or traceback."""

    said: str
    detail: str = ""


def damaged(reader: Reader, seed: int, case: int) -> tuple[Files, Files, bool, str]:
    """Damage an example: the example, its damaged files, whether they contradict themselves, and what is there.

    The last is what is there instead of a file, "" for a file.
    """
    number = READERS.index(reader)
    rng = np.random.default_rng((seed, number, case))
    files = _example(number, seed, case % _EXAMPLES)
    if rng.random() < _ODD_PLACE:
        place = str(rng.choice(_PLACES))
        return files, files, place != "nothing" or reader.name not in _MAY_BE_MISSING, place
    content = files[reader.target]
    if reader.target == "dataset.yaml" and rng.random() < _UNITS:
        swapped = content.replace(
            *((b"clouds: m,", b"clouds: mm,") if rng.random() < 0.5 else (b"poses: m}", b"poses: mm}"))
        )
        return files, {**files, reader.target: swapped}, True, ""
    wrong = False
    for step in range(1 if rng.random() < 0.8 else 3):
        try:
            content, contradicts = GRAMMARS[reader.kind](content, rng)
        except Exception:  # what an earlier damage left is beyond the grammar
            break
        wrong = contradicts and step == 0  # a second damage may undo the contradiction
        if contradicts or not content:
            break
    if reader.name == "weld-table":  # its checksum stands in the header
        wrong = True
    return files, {**files, reader.target: content}, wrong, ""


@lru_cache(maxsize=2 * _EXAMPLES)
def _example(number: int, seed: int, variant: int) -> Files:
    return READERS[number].example(np.random.default_rng((seed, number, variant, 1)))


def lay_out(folder: Path, files: Files, target: str, place: str = "") -> None:
    """Write the files; at the target's place something else, where ``place`` says so."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    path = folder / target
    if place:
        path.unlink()
    if place == "a pipe":
        os.mkfifo(path)
    elif place == "a folder":
        path.mkdir()
    elif place == "a device":
        path.symlink_to("/dev/zero")
    elif place == "a loop of links":
        path.symlink_to(path.name)


def judge(reader: Reader, seed: int, case: int, folder: Path) -> ReaderVerdict:
    """Build, damage and read a case in the folder, which is the working directory of this process."""
    example, files, contradicts, place = damaged(reader, seed, case)
    lay_out(folder, files, reader.target, place)
    verdict, values = _read(reader, folder)
    if any(path.name == "executed" for path in (*folder.iterdir(), *Path.cwd().iterdir())):
        return ReaderVerdict(EXECUTED)
    if verdict.said != ACCEPTED:
        return verdict
    if reader.finite and not all_finite(values):
        return ReaderVerdict(WRONG, "numbers that are not finite were accepted")
    if contradicts:
        lay_out(folder, example, reader.target)
        _, original = _read(reader, folder)
        if digest(values) != digest(original):
            lay_out(folder, files, reader.target, place)
            return ReaderVerdict(WRONG, "a file that contradicts itself was accepted, with other data")
    return verdict


def _read(reader: Reader, folder: Path) -> tuple[ReaderVerdict, Any]:
    try:
        values = reader.read(folder)
    except InputError as e:
        sentence = str(e)
        if not sentence or "\n" in sentence or len(sentence) > _LONGEST:
            return ReaderVerdict(INTERNAL, f"no clear sentence ({len(sentence)} characters): {sentence[:200]}"), None
        return ReaderVerdict(REFUSED, sentence), None
    except Exception:
        return ReaderVerdict(INTERNAL, traceback.format_exc(limit=-6)), None
    return ReaderVerdict(ACCEPTED), values


def digest(values: Any) -> str:
    """Return a hash of what was read."""
    return sha256(pickle.dumps(values)).hexdigest()


WATCHDOG_S = 10.0
WORKER = ("-m", "tests.fuzz.damaged_files")
_START_S = 120.0  # to import everything, on a slow computer
FREE = 1024**3  # bytes above those of the idle process that any file may take
TIMES = 10  # and as many times the size of the file


class Child:
    """A worker process, started anew after it hung, died or took too much memory."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def ask(self, reader: Reader, seed: int, case: int) -> tuple[ReaderVerdict, float]:
        """Return the verdict of a case, and how many seconds it took with making its files."""
        limit = WATCHDOG_S if self._process is not None else WATCHDOG_S + _START_S
        process = self._process or self._start()
        assert process.stdin is not None
        try:
            process.stdin.write(f"{reader.name} {seed} {case}\n")
            process.stdin.flush()
        except BrokenPipeError:
            self._end()
            return ReaderVerdict(CRASH, "the worker ended before the case"), 0.0
        answer = self._line(process, limit)
        if answer is None:
            hung = process.poll() is None
            self._end()
            if hung:
                return ReaderVerdict(HANG, f"no answer within {WATCHDOG_S:g} s"), WATCHDOG_S
            return ReaderVerdict(CRASH, f"exit {process.returncode}"), 0.0
        said: dict[str, Any] = json.loads(answer)
        if said["said"] == MEMORY:  # the next case begins with little
            self._end()
        return ReaderVerdict(said["said"], said["detail"]), said["seconds"]

    def _start(self) -> subprocess.Popen[str]:
        shutil.rmtree(self._place, ignore_errors=True)
        self._place.mkdir()
        command = [sys.executable, "-P", *WORKER, str(self._place)]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "PYTHONUNBUFFERED": "1",
                "PYTHONPATH": os.pathsep.join(sys.path),
            },
        )
        return self._process

    def _line(self, process: subprocess.Popen[str], limit: float) -> str | None:
        """Return the next line of the worker; None where none comes in time, or the worker ends."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            if not selector.select(limit):
                return None
        line = process.stdout.readline()
        if not line:
            process.wait()
        return line or None

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def main() -> None:
    """Work in the folder that is the first argument until the input ends."""
    folder = Path(sys.argv[1])
    os.chdir(folder)
    warnings.simplefilter("ignore")
    readers = {reader.name: reader for reader in READERS}
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print must not come between the answers
    idle = _peak()
    for line in sys.stdin:
        name, seed, case = line.split()
        place = folder / "case"
        begin = time.monotonic()
        verdict = judge(readers[name], int(seed), int(case), place)
        seconds = time.monotonic() - begin
        size = sum(p.stat().st_size for p in place.rglob("*") if p.is_file() and not p.is_symlink())
        if too_much(_peak() - idle, size):
            verdict = ReaderVerdict(MEMORY, f"{(_peak() - idle) / 2**20:.0f} MiB for {size} bytes; {verdict.said}")
        answers.write(json.dumps({"said": verdict.said, "detail": verdict.detail, "seconds": seconds}) + "\n")
        answers.flush()


def too_much(taken: int, size: int) -> bool:
    """Return whether a case took more bytes than files of so many bytes may."""
    return taken > FREE + TIMES * size


def _peak() -> int:
    """Return the largest resident size so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
