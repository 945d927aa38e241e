"""Opens the files that an operator hands in, within bounds, and writes results: whole, absent, or refused.

A file is a regular one of bounded size, text in UTF-8; anything else is refused by a sentence. Each file and folder of
a result is complete, absent, or refused by every reader.
"""

import contextlib
import hashlib
import io
import os
import re
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO, Final

from weldcal.models.errors import InputError

LARGEST_BYTES = 2 * 1024**3
"""Bytes of any file."""
LARGEST_TEXT = 256 * 1024**2
"""Bytes of a text cloud."""
LARGEST_TABLE = 64 * 1024**2
"""Bytes of a CSV table: as rows by name it takes some twenty times as much memory."""
MOST_CELLS = 10_000_000
"""Cells of a CSV table."""
MOST_COLUMNS = 200
"""Columns of a CSV table."""
LARGEST_DOCUMENT = 16 * 1024**2
"""Bytes of a YAML or JSON file."""
MOST_NODES = 1_000_000
"""Values of a YAML or JSON file, each alias counted in full."""
DEEPEST = 50
"""Levels of a YAML or JSON file."""
MOST_POINTS = 50_000_000
"""Points of a cloud."""
MOST_ARRAYS = 1000
"""Arrays of an npz file."""
LARGEST_IMAGE = 128 * 1024**2
"""Bytes of an image."""
MOST_PIXELS = 100_000_000
"""Pixels of an image."""
MOST_POSES = 100_000
"""Poses of one list, and lines of a text that holds them: more take minutes to read, and no set of scans has so
many."""
LARGEST_NUMBER = 1e9
"""Size of any coordinate, in the unit of its file: squares and cubes of it are still far from overflow."""

_EXPANDED = 256 * 1024**2
_TIMES = 10


def expansion_limit(size: int) -> int:
    """Bytes to which a file of this size (bytes) may expand as double-precision numbers.

    256 MiB, or ten times its size.

    The largest of today's area scanners (8 megapixels) takes 190 MB; a file that is not compressed never exceeds ten
    times.
    """
    return max(_EXPANDED, _TIMES * size)


_BLOCK = 1024**2
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def file_size(path: Path, limit: int = LARGEST_BYTES) -> int:
    """Bytes of a regular file (or of the one that a link leads to), without opening it.

    Raises:
        InputError: it does not exist, is a folder, pipe, device or socket, or is larger than ``limit``.
    """
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"There is no file '{path}'.") from None
    except (OSError, ValueError) as e:  # a loop of links, a name that is too long or holds a null character
        raise InputError(f"'{path}' cannot be opened: {_reason(e)}.") from None
    return _checked(path, status, limit)


def require_few_lines(path: Path, most: int = MOST_POSES) -> None:
    """Refuse a text with more lines than a list of poses may have, before it is parsed.

    Raises:
        InputError: as opened; it has more lines than ``most``.
    """
    with opened(path) as file:
        lines = sum(block.count(b"\n") for block in iter(lambda: file.read(_BLOCK), b""))
    if lines > most + 1:
        raise InputError(
            f"'{path.name}' holds {lines:,} lines, and at most {most:,} poses are read. Keep one row for each scan or"
            " picture: the pose at its time."
        )


@contextmanager
def opened(path: Path, limit: int = LARGEST_BYTES) -> Iterator[BinaryIO]:
    """The file, open for reading bytes; never waits for a pipe's other end.

    Raises:
        InputError: as file_size; it cannot be opened or read, or memory runs out inside the block.
    """
    file_size(path, limit)
    try:
        # the file may have been replaced since: what was opened is what must be regular
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError as e:
        raise InputError(f"'{path}' cannot be opened: {_reason(e)}.") from None
    with os.fdopen(handle, "rb") as stream:
        _checked(path, os.fstat(handle), limit)
        try:
            yield stream
        except MemoryError:
            raise InputError(f"'{path.name}' needs more memory than there is: give a smaller file.") from None
        except OSError as e:
            raise InputError(f"'{path.name}' cannot be read: {_reason(e)}.") from None


def read_bytes(path: Path, limit: int = LARGEST_BYTES) -> bytes:
    """Return the contents of a regular file. Raises InputError as ``opened``."""
    with opened(path, limit) as stream:
        content = stream.read(limit + 1)
    if len(content) > limit:  # a file of the kernel's, whose size is not stated
        raise _too_large(path, limit)
    return content


def read_text(path: Path, limit: int = LARGEST_TABLE) -> str:
    """Return the text of a UTF-8 file, with or without a byte-order mark.

    Raises:
        InputError: as ``opened``; it is UTF-16, in another encoding, or not text.
    """
    return decoded(path, read_bytes(path, limit))


def decoded(path: Path, content: bytes) -> str:
    """Return the text of bytes that were read from ``path``. Raises InputError as read_text."""
    if content.startswith(_UTF16):
        raise InputError(f"'{path.name}' cannot be read as text: it is UTF-16; save it as UTF-8.")
    if b"\0" in content:
        raise InputError(f"'{path.name}' cannot be read as text: it holds null characters; save it as UTF-8.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = content.count(b"\n", 0, e.start) + 1
        raise InputError(
            f"'{path.name}' cannot be read as text: line {line} is not UTF-8 (it may be Latin-1); save it as UTF-8."
        ) from None
    except MemoryError:
        raise InputError(f"'{path.name}' needs more memory than there is: give a smaller file.") from None


def sha256(path: Path) -> str:
    """SHA-256 of a regular file in hexadecimal, read block by block. Raises InputError as ``opened``."""
    digest, left = hashlib.sha256(), LARGEST_BYTES
    with opened(path) as stream:
        while left > 0 and (block := stream.read(_BLOCK)):
            digest.update(block)
            left -= len(block)
    return digest.hexdigest()


def _checked(path: Path, status: os.stat_result, limit: int) -> int:
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for test, name in _KINDS if test(status.st_mode)), "not a file")
        raise InputError(f"'{path}' is {kind}; give a file.")
    if status.st_size > limit:
        raise _too_large(path, limit)
    return status.st_size


def _too_large(path: Path, limit: int) -> InputError:
    return InputError(f"'{path.name}' is larger than {limit / 1024**2:.0f} MiB, the most that is read of such a file.")


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


_MOST_DIGITS = 40
"""Digits in a row beyond which a text holds no measurement: a double has 17."""


def require_short_numbers(text: str, name: str) -> None:
    """Refuse a text with a number of more digits in a row than any measurement has.

    Raises:
        InputError: with the number's beginning.
    """
    found = re.search(rf"\d{{{_MOST_DIGITS},}}", text)
    if found is not None:
        raise InputError(
            f"'{name}' holds a number of {len(found[0])} digits ({found[0][:6]} ...): the file is damaged. Export it"
            " again."
        )


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
