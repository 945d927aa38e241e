"""One case: an example of a reader's file is built, damaged and read; the verdict says what the reader did."""

import os
import pickle
import shutil
import traceback
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.models.errors import InputError
from weldcal.tools.studies.files.readers import READERS, Reader, all_finite
from weldcal.tools.worlds import binary_damage, text_damage
from weldcal.tools.worlds.file_examples import Files

ACCEPTED, REFUSED, INTERNAL, WRONG = "accepted", "refused", "internal error", "silently wrong"
HANG, MEMORY, CRASH, EXECUTED = "hang", "memory", "crash", "executed"
GOOD = (ACCEPTED, REFUSED)
GRAMMARS = text_damage.GRAMMARS | binary_damage.GRAMMARS
_PLACES = ("a pipe", "a folder", "a device", "a loop of links", "nothing")
_ODD_PLACE = 0.02  # share of the cases in which no regular file is there
_UNITS = 0.05  # and in which a dataset's unit is exchanged
_EXAMPLES = 40  # different ones of each reader
_LONGEST = 1010  # characters of a refusal


@dataclass(frozen=True)
class Verdict:
    """What a reader did with a case, and its sentence or traceback."""

    said: str
    detail: str = ""


def damaged(reader: Reader, seed: int, case: int) -> tuple[Files, Files, bool, str]:
    """The example, the damaged files, whether they contradict themselves, and what is there instead of a file ("" a file)."""
    number = READERS.index(reader)
    rng = np.random.default_rng((seed, number, case))
    files = _example(number, seed, case % _EXAMPLES)
    if rng.random() < _ODD_PLACE:
        return files, files, True, str(rng.choice(_PLACES))
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


def judge(reader: Reader, seed: int, case: int, folder: Path) -> Verdict:
    """Build, damage and read a case in the folder, which is the working directory of this process."""
    example, files, contradicts, place = damaged(reader, seed, case)
    lay_out(folder, files, reader.target, place)
    verdict, values = _read(reader, folder)
    if any(path.name == "executed" for path in (*folder.iterdir(), *Path.cwd().iterdir())):
        return Verdict(EXECUTED)
    if verdict.said != ACCEPTED:
        return verdict
    if reader.finite and not all_finite(values):
        return Verdict(WRONG, "numbers that are not finite were accepted")
    if contradicts:
        lay_out(folder, example, reader.target)
        _, original = _read(reader, folder)
        if digest(values) != digest(original):
            lay_out(folder, files, reader.target, place)
            return Verdict(WRONG, "a file that contradicts itself was accepted, with other data")
    return verdict


def _read(reader: Reader, folder: Path) -> tuple[Verdict, Any]:
    try:
        values = reader.read(folder)
    except InputError as e:
        sentence = str(e)
        if not sentence or "\n" in sentence or len(sentence) > _LONGEST:
            return Verdict(INTERNAL, f"no clear sentence ({len(sentence)} characters): {sentence[:200]}"), None
        return Verdict(REFUSED, sentence), None
    except Exception:
        return Verdict(INTERNAL, traceback.format_exc(limit=-6)), None
    return Verdict(ACCEPTED), values


def digest(values: Any) -> str:
    """A hash of what was read."""
    return sha256(pickle.dumps(values)).hexdigest()
