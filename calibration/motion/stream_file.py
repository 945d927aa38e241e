"""Tells a file of two pose streams from other npz files."""

from pathlib import Path

from weldcal.models.array_files import read_npz
from weldcal.models.errors import InputError


def is_stream_file(path: Path) -> bool:
    """Whether a file is an npz with the arrays `hand` and `eye`."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        return {"hand", "eye"} <= set(read_npz(path, ("hand", "eye")))
    except InputError:
        return False
