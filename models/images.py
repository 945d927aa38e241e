"""Reads an image of bounded size in grey; its size is read from its header before it is decoded."""

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.models.files import read_bytes
from weldcal.models.limits import LARGEST_IMAGE, MOST_PIXELS

_PNG = b"\x89PNG\r\n\x1a\n"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG's markers that are followed by a height and width


def read_grey_image(path: Path) -> NDArray[np.uint8]:
    """The image (height, width) of a file in any format that OpenCV knows.

    Raises:
        InputError: no regular file, no image, or more pixels than the bound in limits.
    """
    content = read_bytes(path, LARGEST_IMAGE)
    width, height = _size(content)
    if width * height > MOST_PIXELS:
        raise InputError(
            f"'{path.name}' has {width} by {height} pixels, more than {MOST_PIXELS}, the most that are read."
        )
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE) if content else None
    except (cv2.error, MemoryError):
        picture = None
    if picture is None:
        raise InputError(f"'{path.name}' is not a readable image.")
    return np.asarray(picture, dtype=np.uint8)


def _size(content: bytes) -> tuple[int, int]:
    """Width and height that a PNG, JPEG or BMP states; 0 for other formats, which OpenCV bounds itself."""
    if content.startswith(_PNG) and len(content) >= 24:
        width, height = struct.unpack(">II", content[16:24])
        return width, height
    if content.startswith(b"BM") and len(content) >= 26:
        width, height = struct.unpack("<ii", content[18:26])
        return abs(width), abs(height)
    at = 2 if content.startswith(b"\xff\xd8") else len(content)
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], struct.unpack(">H", content[at + 2 : at + 4])[0]
        if marker in _FRAMES:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return 0, 0
