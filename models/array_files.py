"""Reads npz and npy files of plain numbers and words; their headers are checked before anything is expanded."""

import contextlib
import struct
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_IMAGE, MOST_ARRAYS, MOST_PIXELS, expansion_limit, opened, read_bytes

_PNG = b"\x89PNG\r\n\x1a\n"
_DEFLATED = 8 * 1032  # pixels of one bit in a byte of a PNG: deflate expands by 1032 at most
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG's markers that are followed by a height and width


def read_grey_image(path: Path) -> NDArray[np.uint8]:
    """Return the image (height, width) of a file in any format that OpenCV knows.

    Raises:
        InputError: no regular file, no image, or more pixels than the bound in limits.
    """
    return np.asarray(_decoded(path, grey=True), dtype=np.uint8)


def read_raw_image(path: Path) -> NDArray[Any]:
    """Return the pixels (height, width) or (height, width, channels) of a file as they are stored.

    Raises InputError as read_grey_image.
    """
    return _decoded(path, grey=False)


def png_depth(path: Path) -> tuple[int, int]:
    """Bits and channels of a PNG, of which only the header is read; zeros where the file is none."""
    try:
        with opened(path, LARGEST_IMAGE) as stream:
            begin = stream.read(26)
    except InputError:
        return 0, 0
    if not begin.startswith(_PNG) or len(begin) < 26:
        return 0, 0
    return begin[24], {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(begin[25], 0)


def _decoded(path: Path, *, grey: bool) -> NDArray[Any]:
    import cv2  # slow to import

    content = read_bytes(path, LARGEST_IMAGE)
    width, height = _size(content)
    if width * height > MOST_PIXELS:
        raise InputError(
            f"'{path.name}' has {width} by {height} pixels, more than {MOST_PIXELS}, the most that are read."
        )
    if content.startswith(_PNG) and (
        max(width, 1) * max(height, 1) > _DEFLATED * len(content) or not _whole_png(content)
    ):
        raise InputError(
            f"'{path.name}' is damaged: it promises {width} by {height} pixels, more than {len(content)} bytes can"
            " hold, or is cut off."
        )
    flag = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_UNCHANGED
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flag) if content else None
    except (cv2.error, MemoryError):
        picture = None
    if picture is None:
        raise InputError(f"'{path.name}' is not a readable image.")
    return np.asarray(picture)


def _whole_png(content: bytes) -> bool:
    """Return whether no part of a PNG is longer than what follows: OpenCV makes space for it before it reads."""
    at = len(_PNG)
    while at + 8 <= len(content):
        at += 12 + struct.unpack_from(">I", content, at)[0]
    return at <= len(content)


def _size(content: bytes) -> tuple[int, int]:
    """Width and height that a PNG, JPEG, BMP or TIFF states; 0 for other formats, which OpenCV bounds itself."""
    if content.startswith(_PNG) and len(content) >= 24:
        width, height = struct.unpack(">II", content[16:24])
        return width, height
    if content.startswith(b"BM") and len(content) >= 26:
        width, height = struct.unpack("<ii", content[18:26])
        return abs(width), abs(height)
    if content[:4] in _TIFF:
        return _tiff_size(content)
    at = 2 if content.startswith(b"\xff\xd8") else len(content)
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], struct.unpack(">H", content[at + 2 : at + 4])[0]
        if marker in _FRAMES:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return 0, 0


def _tiff_size(content: bytes) -> tuple[int, int]:
    """Return the largest width and height among the entries of a TIFF's first directory."""
    order = _TIFF[content[:4]]
    sides = {256: 0, 257: 0}
    at = struct.unpack_from(f"{order}I", content, 4)[0] if len(content) >= 8 else len(content)
    if at + 2 <= len(content):
        for entry in range(struct.unpack_from(f"{order}H", content, at)[0]):
            place = at + 2 + 12 * entry
            if place + 12 > len(content):
                break
            tag, kind = struct.unpack_from(f"{order}HH", content, place)
            if tag in sides:
                value = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", content, place + 8)[0]
                sides[tag] = max(sides[tag], value)
    return sides[256], sides[257]


_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_KINDS = "biufSU"
_LONGEST_HEADER = 10_000
# what zipfile, zlib and NumPy raise for damaged files
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    SyntaxError,
    tokenize.TokenError,
    OverflowError,
)

AnyArray = NDArray[Any]


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, AnyArray]:
    """Arrays of an npz by name, as stored: all, or those of ``names`` that it holds.

    Every array that is read is checked first: plain numbers or words, as many bytes as its header says, and all of them
    together within expansion_limit at 8 bytes a number.

    Raises:
        InputError: no regular file, no npz, damaged, an array twice, Python objects, or too large once expanded.
    """
    with _undamaged(path, "NPZ"), opened(path) as stream, zipfile.ZipFile(stream) as archive:
        members = _members(path, archive)
        wanted = {k: m for k, m in members.items() if names is None or k in names}
        numbers = 0
        for name, member in wanted.items():
            with archive.open(member) as inside:
                numbers += _header(f"'{name}' in {path.name}", inside, member.file_size)[2]
        _check_expansion(path, numbers, stream)
        found = {}
        for name, member in wanted.items():
            with archive.open(member) as inside:
                found[name] = _array(inside, f"'{name}' in {path.name}", member.file_size)
        return found


def read_npy(path: Path) -> AnyArray:
    """Return the array of an npy file, as stored. Raises InputError as read_npz."""
    with _undamaged(path, "NPY"), opened(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        _check_expansion(path, _header(path.name, stream, size)[2], stream)
        stream.seek(0)
        return _array(stream, path.name, size)


def npy_shape(path: Path) -> tuple[int, ...]:
    """Return the shape that the header of an npy file states. Raises InputError as read_npz."""
    with _undamaged(path, "NPY"), opened(path) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        return _header(path.name, stream, size)[0]


@contextlib.contextmanager
def _undamaged(path: Path, kind: str) -> Iterator[None]:
    """Raise InputError in place of what zipfile, zlib and NumPy raise for damaged files."""
    try:
        yield
    except InputError:
        raise
    except _DAMAGED as e:
        raise InputError(
            f"The file {path.name} cannot be read as {kind}: it is not an {kind.lower()} file, or damaged"
            f" ({type(e).__name__})."
        ) from e


def _members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the arrays that the central directory lists, by name."""
    listed = [m for m in archive.infolist() if m.filename.endswith(".npy")]
    if len(archive.infolist()) > MOST_ARRAYS:
        raise InputError(f"The file {path.name} holds more than {MOST_ARRAYS} arrays.")
    name, times = max(Counter(m.filename for m in listed).items(), key=lambda item: item[1], default=("", 1))
    if times > 1:
        raise InputError(f"The file {path.name} holds '{name.removesuffix('.npy')}' twice; keep one.")
    for member in listed:
        if member.compress_type not in _METHODS or member.flag_bits & 1:
            raise InputError(
                f"The file {path.name} is encrypted, or its compression is not one of NumPy's. Save it again with"
                " NumPy."
            )
    return {m.filename.removesuffix(".npy"): m for m in listed}


def _header(what: str, stream: Any, size: int) -> tuple[tuple[int, ...], bool, int, np.dtype[Any]]:
    """Shape, order, how many 8-byte numbers it expands to, and type of an array whose file has ``size`` bytes."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        header = np.lib.format.read_array_header_1_0(stream, max_header_size=_LONGEST_HEADER)
    elif version == (2, 0):
        header = np.lib.format.read_array_header_2_0(stream, max_header_size=_LONGEST_HEADER)
    else:
        raise InputError(f"{what} is not an array of plain numbers.")
    shape, order, dtype = header
    if dtype.kind not in _KINDS or dtype.hasobject or dtype.itemsize == 0:
        raise InputError(f"{what} holds {dtype}, not plain numbers; nothing else is read.")
    count = 1
    for n in shape:
        if isinstance(n, bool) or n < 0:
            raise InputError(f"{what} has the impossible shape {shape}.")
        count *= n
    there = size - stream.tell()
    if count * dtype.itemsize != there:
        raise InputError(
            f"{what} is damaged: its header promises {count * dtype.itemsize} bytes and {there} are there; save it"
            " again."
        )
    return shape, order, max(count, count * dtype.itemsize // 8), dtype


def _array(stream: Any, what: str, size: int) -> AnyArray:
    shape, order, _, dtype = _header(what, stream, size)
    count = 1
    for n in shape:
        count *= n
    content = np.empty(count * dtype.itemsize, np.uint8)
    rest = content.data
    while rest and (n := stream.readinto(rest)):
        rest = rest[n:]
    if rest:
        raise InputError(f"{what} is truncated; save it again.")
    values = content.view(dtype)
    return values.reshape(shape[::-1]).T if order else values.reshape(shape)


def _check_expansion(path: Path, numbers: int, stream: BinaryIO) -> None:
    here = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(here)
    if 8 * numbers > expansion_limit(size):
        raise InputError(
            f"The file {path.name} would expand to {8e-6 * numbers:.0f} MB, more than the"
            f" {1e-6 * expansion_limit(size):.0f} MB that are read of a file of its size."
        )
