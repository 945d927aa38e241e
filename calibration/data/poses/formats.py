"""Every form of a file of poses: a row of FORMATS and the function that reads it. A new form is one of each."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from weldcal.calibration.data.poses.names import TEXT, TREES
from weldcal.calibration.errors import DatasetError
from weldcal.models.array_files import read_npy, read_npz
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, file_size, read_bytes, read_text, require_few_lines

if TYPE_CHECKING:
    from weldcal.calibration.data.poses.listing import Listing

EXTRAS = ("X_true", "img", "obj", "K", "dist", "q")
"""What a file may hold beside its lists: the published answer, corners and their camera, joint angles."""
_PICKLED = (
    "'{}' holds Python objects (a pickle), which may run code: save the two arrays with numpy.savez(file, robot=...,"
    " camera=...)."
)
_BEGINNING = 4000  # characters that show what a text is
_TREE_TEXT = re.compile(
    r"(?m)^\s*(position|translation|orientation|rotation|pose|transforms?):[ \t\r]*$|\A\s*\[?\s*\{\s*\""
)
_TABLE_TEXT = re.compile(r"(?m)^At time|Translation: \[")


@dataclass(frozen=True)
class PoseFile:
    """What a file holds: every list of poses, and what else is stated: `mode` (mounting), `unit` and EXTRAS."""

    lists: "list[Listing]"
    stated: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Format:
    """One form of a file: its name for messages, endings and reader.

    ``sniff`` tells forms of one ending apart. ``in_folders``: whether it is sought in folders, or must be named.
    """

    says: str
    endings: tuple[str, ...]
    read: Callable[[Path], PoseFile]
    sniff: Callable[[Path], bool] = lambda path: True
    in_folders: bool = True


def format_of(path: Path) -> Format:
    """Return the form of a file, by its ending and then its content; one of an unknown ending is taken as text.

    Raises InputError.
    """
    ending = ".mcap" if path.is_dir() else path.suffix.lower()  # a folder that is named is a recording of ROS 2
    ending = ending if any(ending in one.endings for one in FORMATS) else TEXT[0]
    return next(one for one in FORMATS if ending in one.endings and one.sniff(path))


def may_hold_poses(path: Path) -> bool:
    """Return whether the name of a file of a folder is that of poses, by its ending."""
    return any(path.suffix.lower() in one.endings for one in FORMATS if one.in_folders)


def known_forms() -> str:
    """Return the forms that are read, with their endings, for messages."""
    known = {one.says: ", ".join(one.endings[:4]) for one in FORMATS if one.in_folders}
    return "; ".join(f"{says} ({endings})" for says, endings in known.items())


def read_recording(path: Path) -> PoseFile:
    """Read a file of any form.

    Raises:
        DatasetError: the file cannot be read, or holds no poses; the sentence says what to change.
    """
    try:
        if not path.is_dir():
            file_size(path)
        return format_of(path).read(path)
    except DatasetError:
        raise
    except InputError as problem:
        raise DatasetError(str(problem)) from problem


def _npz(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.trees import lists_of_tree

    arrays = read_npz(path)
    if "hand" in arrays and "eye" in arrays:
        raise DatasetError(
            f"'{path.name}' holds two streams of poses, not pairs: bring them to one clock and write pairs, A and B"
            " (n, 4, 4)."
        )
    stated: dict[str, Any] = {k: arrays[k] for k in EXTRAS if k in arrays}
    stated["mode"], stated["unit"] = (
        next((_word(arrays[k]) for k in keys if k in arrays and np.size(arrays[k]) == 1), "")
        for keys in (("mode", "configuration"), ("unit",))
    )
    return PoseFile(lists_of_tree({k: v for k, v in arrays.items() if k not in stated or k == "q"}, path.name), stated)


def _word(value: Any) -> str:
    word = np.ravel(value)[0]
    return word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word)


def _npy(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.listing import listing_of_array

    try:
        value = read_npy(path)
    except InputError as problem:
        if "holds object" not in str(problem):
            raise
        raise DatasetError(_PICKLED.format(path.name)) from problem
    if value.dtype.kind not in "fiu":
        raise DatasetError(f"'{path.name}' holds words, not numbers.")
    return PoseFile([listing_of_array(path.name, value.astype(float))])


def _pickle(path: Path) -> PoseFile:
    raise DatasetError(_PICKLED.format(path.name))


def _matlab(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.storage import matlab_arrays
    from weldcal.calibration.data.poses.trees import lists_of_tree

    return PoseFile(lists_of_tree(matlab_arrays(read_bytes(path, LARGEST_DOCUMENT), path.name), path.name))


def _is_numbers(path: Path) -> bool:
    """Return whether a .mat file is a table of numbers, as MATLAB's save -ascii writes it."""
    with path.open("rb") as stream:
        return re.fullmatch(rb"[\s\d.eE+,;-]+", stream.read(128)) is not None


def _workbook(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.text import lists_of_text, sheets_of

    sheets = sheets_of(path)
    names = {title: f"{path.name}, {title}" if len(sheets) > 1 else path.name for title in sheets}
    return PoseFile([one for title, text in sheets.items() for one in lists_of_text(text, names[title])])


def _document(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.storage import read_tree
    from weldcal.calibration.data.poses.text import keyed_lists
    from weldcal.calibration.data.poses.trees import lists_of_tree

    if path.suffix.lower() == ".xml" and (lines := keyed_lists(read_text(path), path.name)):
        return PoseFile(lines)
    tree = read_tree(path)
    named = tree if isinstance(tree, dict) else {}
    stated = {k: named[k] for k in (*EXTRAS, "unit") if k in named}
    parameters = named.get("parameters")
    kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
    stated["mode"] = named.get("mode") or named.get("configuration") or kind
    samples = named.get("samples", named.get("poses")) if named else tree
    if isinstance(samples, list) and samples and all(isinstance(one, dict) and "q" in one for one in samples):
        stated["q"] = [one["q"] for one in samples]
    return PoseFile(lists_of_tree(tree, path.name), stated)


def _is_document(path: Path) -> bool:
    """Return whether a text is a document in YAML or JSON, such as `ros2 topic echo` prints."""
    require_few_lines(path)
    begin = read_text(path)[:_BEGINNING]
    return bool(_TREE_TEXT.search(begin)) and not _TABLE_TEXT.search(begin)


def _document_text(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.storage import tree_of_text
    from weldcal.calibration.data.poses.trees import lists_of_tree

    text = read_text(path)
    kind = "JSON" if text.lstrip().startswith(("{", "[")) else "YAML"
    return PoseFile(lists_of_tree(tree_of_text(text, path.name, kind), path.name))


def _text(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.text import lists_of_text

    require_few_lines(path)
    return PoseFile(lists_of_text(read_text(path), path.name))


def _program(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.programs import unzipped
    from weldcal.calibration.data.poses.text import lists_of_text

    return PoseFile(lists_of_text(unzipped(path), path.name))


def _recording(path: Path) -> PoseFile:
    from weldcal.calibration.data.poses.bag import lists_of_recording

    return PoseFile(lists_of_recording(path))


FORMATS = (
    Format("arrays of NumPy", (".npz",), _npz),
    Format("an array of NumPy", (".npy",), _npy),
    Format("numbers of MATLAB", (".mat",), _text, _is_numbers),
    Format("MATLAB 5 to 7", (".mat",), _matlab),
    Format("Excel", (".xlsx",), _workbook),
    Format("YAML, JSON or XML", TREES, _document),
    Format("a program of UR", (".urp",), _program),
    Format("a document as text", TEXT, _document_text, _is_document),
    Format("a table, a robot program or a log", TEXT, _text),
    Format("a recording of ROS", (".mcap", ".db3", ".bag"), _recording, in_folders=False),
    Format("a pickle", (".pkl", ".pickle"), _pickle, in_folders=False),
)
