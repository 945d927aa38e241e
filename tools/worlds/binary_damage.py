"""Damages binary files by the grammar of their format: clouds with headers, npz and npy, images, and bytes of any
kind."""

import io
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np
from scipy.io import savemat

from weldcal.calibration.data.poses.storage import matlab_arrays
from weldcal.tools.worlds.text_damage import Damage, Rng, any_text

_HUGE = ("0", "-1", "59", "61", "100000000", "5000000000", "99999999999999999999", "1.5", "x", "")


def _pick(rng: Rng, of: Any) -> Any:
    return of[int(rng.integers(len(of)))]


def any_bytes(content: bytes, rng: Rng) -> Damage:
    """Bits flipped, pieces cut, zeroed, doubled, swapped or added."""
    a, b = sorted(int(v) for v in rng.integers(len(content) + 1, size=2))
    kind = int(rng.integers(7))
    if kind == 0:
        flipped = bytearray(content)
        for _ in range(int(rng.integers(1, 9))):
            at = int(rng.integers(len(flipped)))
            flipped[at] ^= 1 << int(rng.integers(8))
        return bytes(flipped), False
    if kind == 1:
        return content[:a], False
    if kind == 2:
        return content[:a] + content[b:], False
    if kind == 3:
        return content[:a] + b"\0" * (b - a) + content[b:], False
    if kind == 4:
        return content[:b] + content[a:b] + content[b:], False
    if kind == 5:
        return content[:a] + bytes(rng.integers(0, 256, int(rng.integers(1, 200)), dtype=np.uint8)) + content[a:], False
    return bytes(rng.integers(0, 256, int(rng.integers(1, 2000)), dtype=np.uint8)), False


def cloud(content: bytes, rng: Rng) -> Damage:
    """PLY and PCD: a header that lies about counts, types, sizes and order, or a body that is cut or longer."""
    end = re.search(rb"(end_header|DATA \w+)\n", content)
    if end is None or rng.random() < 0.15:
        return any_bytes(content, rng)
    head, body = content[: end.end()].decode("latin-1"), content[end.end() :]
    text = b"ascii" in content[: end.end()]
    kind = int(rng.integers(8))
    if kind == 0:  # the body cut: no number may be lost, and the last line of a text may end in the middle of one
        cut = int(rng.integers(len(body)))
        return head.encode("latin-1") + body[:cut], not text
    if kind == 1:
        more = bytes(rng.integers(1, 256, int(rng.integers(16, 400)), dtype=np.uint8))
        return (
            content + more,
            not text and b"list" not in content[: end.end()] and b"compressed" not in content[: end.end()],
        )
    if kind == 2:  # a count that is not the body's
        places = list(re.finditer(r"(?:element \w+|POINTS|WIDTH|HEIGHT|COUNT|SIZE) ([\d ]+)", head))
        spot = _pick(rng, places)
        new = head[: spot.start(1)] + _pick(rng, _HUGE) + head[spot.end(1) :]
        return new.encode("latin-1") + body, "vertex" in spot.group() or spot.group().startswith(("POINTS", "WIDTH"))
    if kind == 3:  # another type
        places = list(re.finditer(r"\b(float|double|int|uchar|list|F|U|I|[1248])\b", head))
        spot = _pick(rng, places)
        swap = _pick(
            rng, ("float", "double", "int", "uchar", "list uchar int", "F", "U", "I", "1", "2", "4", "8", "half")
        )
        return (head[: spot.start()] + swap + head[spot.end() :]).encode("latin-1") + body, False
    if kind == 4:  # another coding
        swap = _pick(rng, ("ascii", "binary", "binary_compressed", "binary_little_endian", "binary_big_endian", "zip"))
        return re.sub(r"(?<=DATA )\w+|(?<=format )\w+", swap, head).encode("latin-1") + body, False
    if kind == 5:
        lines = head.split("\n")
        k, other = (int(v) for v in rng.integers(len(lines), size=2))
        lines[k], lines[other] = (lines[other], lines[k]) if rng.random() < 0.5 else (lines[other], lines[other])
        return "\n".join(lines).encode("latin-1") + body, False
    if kind == 6 and text:
        rows = body.split(b"\n")
        k = int(rng.integers(max(len(rows) - 1, 1)))
        rows = rows[:k] + rows[k + 1 :] if rng.random() < 0.5 else [*rows[:k], rows[k], *rows[k:]]
        return head.encode("latin-1") + b"\n".join(rows), True
    return any_text(content, rng) if text else any_bytes(content, rng)


def npz(content: bytes, rng: Rng) -> Damage:
    """Arrays of other shapes and types, lying headers, an array twice, Python objects, a bomb, damaged compression."""
    kind = int(rng.integers(12))
    if kind == 0:
        return content[: int(rng.integers(len(content)))], True
    if kind == 1:
        return any_bytes(content, rng)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(_pick(rng, list(members)))
    value = np.load(io.BytesIO(members[name]))
    if kind == 2:
        return _bomb(name), True
    if kind == 3:
        members[name] = _lying(members[name], rng)
        return _zip(members, rng), True
    if kind == 4:
        return _zip(members, rng, again=name), True
    if kind == 5:
        members[name] = _objects(value)
        return _zip(members, rng), True
    if kind == 6:
        del members[name]
        return _zip(members, rng), False
    if 7 <= kind <= 10 and (changed := _changed(value, kind - 7, rng)) is not None:
        value = changed
    else:
        flipped = bytearray(content)
        at = int(rng.integers(30, len(flipped)))
        flipped[at] ^= 1 << int(rng.integers(8))
        return bytes(flipped), False
    stream = io.BytesIO()
    np.save(stream, value)
    members[name] = stream.getvalue()
    return _zip(members, rng), False


def _changed(value: np.ndarray, kind: int, rng: Rng) -> np.ndarray | None:
    """Another number, shape or type, or the last row lost; None where the array has no such thing."""
    if kind == 0 and value.dtype.kind == "f" and value.size:
        value = value.copy()
        value.reshape(-1)[int(rng.integers(value.size))] = _pick(rng, (np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0))
        return value
    if kind == 1:
        shapes = (value[:0] if value.ndim else value, value.reshape(-1), value[None], value.T, np.zeros((2, 2)))
        return np.asarray(_pick(rng, shapes))
    if kind == 2 and value.dtype.kind not in "UO":
        return value.astype(str(_pick(rng, ("U20", "S20", "f2", "i1", "c16", "bool", "u8"))), casting="unsafe")
    return value[: len(value) - 1] if kind == 3 and value.ndim else None


def matlab(content: bytes, rng: Rng) -> Damage:
    """MATLAB arrays of other numbers, shapes, types and lengths, a variable lost or twice, or bytes of any kind."""
    kind = int(rng.integers(7))
    if kind == 6:
        return any_bytes(content, rng)
    arrays = matlab_arrays(content, "a.mat")
    name = str(_pick(rng, list(arrays)))
    if kind == 4:
        del arrays[name]
    elif kind == 5:
        arrays[f"{name}{name}"] = arrays[name]
    else:
        value = arrays[name]
        if isinstance(value, list):  # cells
            cells = np.empty((1, len(value)), dtype=object)
            for k, cell in enumerate(value):
                changed = _changed(np.array(cell), kind, rng) if k == 0 else None
                cells[0, k] = np.array(cell) if changed is None else changed
            value = cells
        else:
            changed = _changed(value, kind, rng)
            value = value if changed is None else changed
        arrays[name] = value
    stream = io.BytesIO()
    savemat(cast(Any, stream), arrays)  # takes a stream, too; its stub does not say so
    return stream.getvalue(), False


def npy(content: bytes, rng: Rng) -> Damage:
    """A lying header, a cut body, Python objects."""
    kind = int(rng.integers(4))
    if kind == 0:
        return content[: int(rng.integers(len(content)))], True
    if kind == 1:
        return _lying(content, rng), True
    if kind == 2:
        return _objects(np.load(io.BytesIO(content))), True
    return any_bytes(content, rng)


def _zip(members: dict[str, bytes], rng: Rng, again: str | None = None) -> bytes:
    """A zip of the members; ``again``: one that stands there a second time, with another last byte."""
    stream = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the name that is there twice
        for name, body in members.items():
            archive.writestr(name, body)
        if again is not None:
            archive.writestr(again, members[again][:-1] + bytes([members[again][-1] ^ 1]))
    return stream.getvalue()


def _lying(body: bytes, rng: Rng) -> bytes:
    """An npy whose header promises more than there is, of the same length."""
    found = re.search(rb"'shape': \(([^)]*)\)", body[:256])
    if found is None:
        return body[:-1]
    shape = str(_pick(rng, ("900000000,", "70000, 3", "-5,", "99999999999, 9", "4,"))).encode()
    header_end: int = 10 + struct.unpack("<H", body[8:10])[0]
    head = body[: found.start(1)] + shape + body[found.end(1) : header_end]
    head = head.rstrip(b" \n")
    if len(head) + 1 > header_end:
        return body[:-1]
    return head + b" " * (header_end - len(head) - 1) + b"\n" + body[header_end:]


class _Trap:
    """Unpickled, it would write a file."""

    def __reduce__(self) -> tuple[Any, tuple[str, str]]:
        return open, ("executed", "w")


def _objects(value: np.ndarray) -> bytes:
    stream = io.BytesIO()
    array = np.empty(2, dtype=object)
    array[0] = _Trap()
    array[1] = value.shape
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


@cache
def _bomb(name: str) -> bytes:
    """An npz of a few MB with one array, as large as all its headers say: 2.4 GB of zeros."""
    numbers = 300_000_000
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (numbers // 3, 3)})
    body = _deflated(header.getvalue()) + _deflated(b"\0" * 8_000_000) * (numbers // 1_000_000)
    body += zlib.compressobj(9, zlib.DEFLATED, -15).flush()
    size, label = len(header.getvalue()) + 8 * numbers, name.encode()
    local = struct.pack("<4s5H3L2H", b"PK\3\4", 20, 0, 8, 0, 0, 0, len(body), size, len(label), 0) + label + body
    listed = (
        struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 8, 0, 0, 0, len(body), size, len(label), 0, 0, 0, 0, 0, 0)
        + label
    )
    return local + listed + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(listed), len(local), 0)


def _deflated(content: bytes) -> bytes:
    """A piece of a raw deflate stream that may stand anywhere in it."""
    squeeze = zlib.compressobj(9, zlib.DEFLATED, -15)
    return squeeze.compress(content) + squeeze.flush(zlib.Z_FULL_FLUSH)


def image(content: bytes, rng: Rng) -> Damage:
    """A PNG that promises more pixels, with a right checksum; else bytes of any kind."""
    if content.startswith(b"\x89PNG") and rng.random() < 0.4:
        size = struct.pack(">II", *(int(v) for v in rng.choice([0, 1, 24, 30_000, 2**31 - 1], size=2)))
        chunk = b"IHDR" + size + content[24:29]
        return content[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[33:], False
    return any_bytes(content, rng)


GRAMMARS: dict[str, Callable[[bytes, Rng], Damage]] = {
    "bytes": any_bytes,
    "cloud": cloud,
    "npz": npz,
    "npy": npy,
    "matlab": matlab,
    "image": image,
}
