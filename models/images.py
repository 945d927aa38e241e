"""Reads an image of bounded size in grey; its size is read from its header before it is decoded."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.models.files import opened, read_bytes
from weldcal.models.limits import LARGEST_IMAGE, MOST_PIXELS

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG's markers that are followed by a height and width


def read_grey_image(path: Path) -> NDArray[np.uint8]:
    """The image (height, width) of a file in any format that OpenCV knows.

    Raises:
        InputError: no regular file, no image, or more pixels than the bound in limits.
    """
    return np.asarray(_decoded(path, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def read_raw_image(path: Path) -> NDArray[Any]:
    """The pixels (height, width) or (height, width, channels) of a file as they are stored. Raises InputError as read_grey_image."""
    return _decoded(path, cv2.IMREAD_UNCHANGED)


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


def _decoded(path: Path, flag: int) -> NDArray[Any]:
    content = read_bytes(path, LARGEST_IMAGE)
    width, height = _size(content)
    if width * height > MOST_PIXELS:
        raise InputError(
            f"'{path.name}' has {width} by {height} pixels, more than {MOST_PIXELS}, the most that are read."
        )
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flag) if content else None
    except (cv2.error, MemoryError):
        picture = None
    if picture is None:
        raise InputError(f"'{path.name}' is not a readable image.")
    return np.asarray(picture)


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
    """The largest width and height among the entries of a TIFF's first directory."""
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
