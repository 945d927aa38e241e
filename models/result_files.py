"""Writes result files: each file and each folder is complete, absent, or refused by every reader."""

import contextlib
import io
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final

from weldcal.models.errors import InputError

UNFINISHED: Final = "UNFINISHED"
"""The file that a result folder holds from its first file to its last one."""

SAYS = "weldcal has not finished the result in this folder, and refuses to read it. Run the command again.\n"
_RESULTS: ContextVar[tuple[Path, ...]] = ContextVar("results", default=())


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file and create its folder: another process sees the old content or the new, never a part of it.

    A file of the folder of ``whole_result`` marks that folder as unfinished first.
    """
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    for folder in _RESULTS.get():
        if path.absolute().is_relative_to(folder):
            _mark(folder)
    _replace(path, data)


def write_apart(path: Path, content: str | bytes) -> None:
    """Write a file that is whole by itself, as ``write_atomic`` does.

    It does not make its folder an unfinished result.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, content.encode() if isinstance(content, str) else content)


def write_durable(path: Path, content: str | bytes) -> None:
    """Write a file as ``write_apart`` does, so that it also survives a loss of power from now on."""
    write_apart(path, content)
    _to_disk(path.parent)


def write_npz(path: Path, **arrays: Any) -> None:
    """Write arrays as a compressed NPZ file, as ``write_atomic`` does."""
    import numpy as np  # the command line's help does without it

    data = io.BytesIO()
    # NumPy's own level, 6, takes four times the time and makes a depth image no smaller.
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    write_atomic(path, data.getvalue())


@contextlib.contextmanager
def whole_result(folder: Path) -> Iterator[None]:
    """Make one result of all that is written into ``folder`` within the block.

    The first file marks the folder as unfinished, and the end of the block removes the mark. An exception or the death
    of the process leaves it, so that ``require_whole`` refuses the folder. Blocks may be nested: each folder has its
    own mark.
    """
    folder = folder.absolute()
    before = _RESULTS.set((*_RESULTS.get(), folder))
    mark = folder / UNFINISHED
    try:
        yield
    except BaseException as problem:
        if mark.exists() and str(folder) not in getattr(problem, "__notes__", ()):
            problem.add_note(str(folder))  # for the sentence that names it
        raise
    finally:
        _RESULTS.reset(before)
    if mark.exists():
        mark.unlink()
        _to_disk(folder)


def require_whole(path: Path) -> None:
    """Refuse a result folder, or a file in one, that was not finished.

    Raises:
        InputError: weldcal was ended while it wrote there, or it is still writing.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / UNFINISHED).exists():
        raise InputError(
            f"The result in '{folder}' is not complete: weldcal was ended while it wrote it. Run the command again, or"
            " give another folder."
        )


def _mark(folder: Path) -> None:
    mark = folder / UNFINISHED
    if not mark.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _replace(mark, SAYS.encode())
        _to_disk(folder)


def _replace(path: Path, content: bytes) -> None:
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)  # mkstemp makes it private; a result is for everybody
        Path(temporary).replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            Path(temporary).unlink()
        raise


def _to_disk(folder: Path) -> None:
    """Put the folder's names on the disk, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
