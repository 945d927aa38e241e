"""Damages files by the grammar of their format: tables, YAML, JSON, clouds with headers, npz, images, any bytes."""

import io
import json
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any, cast

import numpy as np
from scipy.io import savemat

from weldcal.calibration.data.poses.storage import matlab_arrays

Rng = np.random.Generator
Damage = tuple[bytes, bool]
"""The damaged bytes, and whether they contradict themselves: if they are accepted with other data, that is silently
wrong."""

NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-0", "-1", "1e9", "1e400", "9" * 400, "0x10", "1_000",
    "1,5", "", "x",
    "\u0663", "true", "null", "[1, 2]", "{a: 1}", "2026-01-01", "~", "'", "1e5", "00012",
)  # fmt: skip
WORDS = (
    "",
    "x",
    "\u00e4" * 3,
    "!!python/object/apply:os.system ['touch executed']",
    "&a *a",
    "!Nobody {}",
    "-",
    "[",
    "a" * 70_000,
)
_NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_PAIR = re.compile(r"^(\s*(?:- )?)([A-Za-z_][\w]*)(: *)(.*)$")


def _pick(rng: Rng, of: Any) -> Any:
    return of[int(rng.integers(len(of)))]


def encoded(content: bytes, rng: Rng) -> Damage:
    """Another encoding of the text; UTF-8 with a mark is still right."""
    text = content.decode("utf-8", "replace")
    if rng.random() < 0.2:
        return text.encode("utf-8-sig"), False
    if rng.random() < 0.6:
        return text.encode(str(_pick(rng, ["utf-16", "utf-16-le", "utf-16-be", "utf-32"]))), True
    at = int(rng.integers(len(text) + 1))
    return (text[:at] + _pick(rng, "\u00e4\u00b0\u00e9") + text[at:]).encode("latin-1", "replace"), False


def any_text(content: bytes, rng: Rng) -> Damage:
    """Numbers, words, lines and encodings changed anywhere."""
    text = content.decode("utf-8", "replace")
    lines = text.split("\n")
    kind = int(rng.integers(8))
    if kind == 0:
        return encoded(content, rng)
    if kind == 1 and (found := list(_NUMBER.finditer(text))):
        spot = _pick(rng, found)
        return (text[: spot.start()] + _pick(rng, NUMBERS) + text[spot.end() :]).encode(), False
    k, other = (int(v) for v in rng.integers(len(lines), size=2))
    if kind == 2:
        del lines[k]
    elif kind == 3:
        lines.insert(other, lines[k])
    elif kind == 4:
        lines[k], lines[other] = lines[other], lines[k]
    elif kind == 5:
        lines[k] = lines[k][: int(rng.integers(len(lines[k]) + 1))]
    elif kind == 6:
        lines[k] += str(_pick(rng, ('"', "\0", "\u2028", ",,,,", ";;", " x", "\t", "\r", "#", ":", "9" * 200_000)))
    else:
        return text[: int(rng.integers(len(text) + 1))].encode(), False
    return "\n".join(lines).encode(), False


def table(content: bytes, rng: Rng) -> Damage:
    """Cells, rows and columns of a CSV table changed, doubled, swapped; decimal commas between commas."""
    text = content.decode()
    separator = max(",;\t", key=text.split("\n", 1)[0].count)
    rows = [line.split(separator) for line in text.rstrip("\n").split("\n")]
    k, c = int(rng.integers(1, len(rows))), int(rng.integers(len(rows[0])))
    kind = int(rng.integers(11))
    wrong = False
    if kind == 0:
        rows[k][c] = str(_pick(rng, NUMBERS))
    elif kind == 1:  # a whole column doubled, with other numbers
        for n, row in enumerate(rows):
            row.append(row[c] if n == 0 else f"{rng.normal():.3f}")
        wrong = True
    elif (
        kind == 2
        and separator == ","
        and (places := [j for j, v in enumerate(rows[k]) if re.fullmatch(r"-?\d+\.\d+", v)])
    ):
        for row in rows[1:] if rng.random() < 0.5 else rows[k : k + 1]:
            for j in places if rng.random() < 0.5 else places[:1]:
                row[j] = row[j].replace(".", ",")
        wrong = any(sum(1 + cell.count(",") for cell in row) > len(rows[0]) for row in rows)
    elif kind == 3:
        rows[k].insert(c, f"{rng.normal():.3f}")
        wrong = len(rows[k]) > len(rows[0])
    elif kind == 4:
        del rows[k][c]
    elif kind == 5:
        for row in rows:
            del row[c]
    elif kind == 6:
        rows[k][c] = "7" * int(rng.integers(130_000, 400_000))
        wrong = True
    elif kind == 7:
        rows[k][c] = '"' + rows[k][c]
    elif kind == 8:
        rows[0][c] = str(_pick(rng, ("", "x", rows[0][0], rows[0][c].upper(), "\u00e4")))
    elif kind == 9:
        rows.insert(k, list(rows[int(rng.integers(len(rows)))]))
    else:
        return any_text(content, rng)
    return ("\n".join(separator.join(row) for row in rows) + "\n").encode(), wrong


def yaml(content: bytes, rng: Rng) -> Damage:
    """Values of other types and sizes, keys doubled, lists shortened, nesting without end."""
    lines = content.decode().split("\n")
    spots = [(n, m) for n, line in enumerate(lines) if (m := _PAIR.match(line))]
    kind = int(rng.integers(9))
    if kind == 0:
        return _yaml_bomb(rng), False
    if not spots or kind == 1:
        return any_text(content, rng)
    n, found = _pick(rng, spots)
    indent, key, colon, value = found.groups()
    if kind == 2:  # the key again, with another value
        lines.insert(n, f"{' ' * len(indent)}{key}{colon}{_pick(rng, ('17', 'word', '[]'))}")
        return "\n".join(lines).encode(), not indent.strip() and value != ""
    if kind == 3 and "[" in value:
        inside = value[value.index("[") + 1 : value.rindex("]")] if "]" in value else value
        cells = inside.split(",")
        del cells[int(rng.integers(len(cells)))]
        lines[n] = f"{indent}{key}{colon}[{', '.join(cells)}]"
    elif kind == 4:
        lines[n] = f"{indent}{key}{colon}{_pick(rng, WORDS)}"
    elif kind == 5:
        lines[n] = f"{indent}{_pick(rng, ('x', '', '17', '_' + key, 'xyz', '<<', '[1, 2]'))}{colon}{value}"
    elif kind == 6:
        numbers = list(_NUMBER.finditer(value))
        if numbers:
            spot = _pick(rng, numbers)
            value = value[: spot.start()] + _pick(rng, NUMBERS) + value[spot.end() :]
        lines[n] = f"{indent}{key}{colon}{value}"
    else:
        lines[n] = f"{indent}{key}{colon}{_pick(rng, NUMBERS)}"
    return "\n".join(lines).encode(), False


def _yaml_bomb(rng: Rng) -> bytes:
    kind = int(rng.integers(4))
    if kind == 0:
        names = [f"a{k}" for k in range(12)]
        first = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
        return (first + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise(names))).encode()
    if kind == 1:
        return b"[" * int(rng.integers(100, 20_000))
    if kind == 2:
        return b"- " * int(rng.integers(100, 20_000))
    return b"a: &a [*a, *a]\n"


def json_text(content: bytes, rng: Rng) -> Damage:
    """Return a tree with a value of another type, ragged lists, missing or doubled keys; or text that ends early."""
    kind = int(rng.integers(6))
    if kind == 0:
        return content[: int(rng.integers(len(content)))], True
    if kind == 1:
        return any_text(content, rng)
    if kind == 2:
        return b"[" * int(rng.integers(100, 100_000)), True
    document = json.loads(content)
    place, key = document, None
    for _ in range(int(rng.integers(1, 7))):
        inner = place if key is None else place[key]
        if not isinstance(inner, dict | list) or not inner:
            break
        place, key = inner, _pick(rng, list(inner) if isinstance(inner, dict) else range(len(inner)))
    odd: tuple[Any, ...] = (
        None,
        True,
        "x",
        [],
        {},
        [1.0, [2.0]],
        1e308,
        float("nan"),
        float("inf"),
        -1,
        10**400,
        [[1.0]],
        "\u00e4",
        {"x": 1},
    )
    if key is not None and kind == 3 and rng.random() < 0.5:
        del place[key]
    elif key is not None:
        place[key] = _pick(rng, odd)
    return json.dumps(document).encode(), False


_HUGE = ("0", "-1", "59", "61", "100000000", "5000000000", "99999999999999999999", "1.5", "x", "")


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
        return _npz_bomb(name), True
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
    """Return a lying header, a cut body, Python objects."""
    kind = int(rng.integers(4))
    if kind == 0:
        return content[: int(rng.integers(len(content)))], True
    if kind == 1:
        return _lying(content, rng), True
    if kind == 2:
        return _objects(np.load(io.BytesIO(content))), True
    return any_bytes(content, rng)


def _zip(members: dict[str, bytes], rng: Rng, again: str | None = None) -> bytes:
    """Return a zip of the members; ``again``: one that is there a second time, with another last byte."""
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
    """Return an npy whose header promises more than there is, of the same length."""
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
def _npz_bomb(name: str) -> bytes:
    """Return an npz of a few MB with one array, as large as all its headers say: 2.4 GB of zeros."""
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
    """Return a piece of a raw deflate stream that may stand anywhere in it."""
    squeeze = zlib.compressobj(9, zlib.DEFLATED, -15)
    return squeeze.compress(content) + squeeze.flush(zlib.Z_FULL_FLUSH)


def image(content: bytes, rng: Rng) -> Damage:
    """Return a PNG that promises more pixels, with a right checksum; else bytes of any kind."""
    if content.startswith(b"\x89PNG") and rng.random() < 0.4:
        size = struct.pack(">II", *(int(v) for v in rng.choice([0, 1, 24, 30_000, 2**31 - 1], size=2)))
        chunk = b"IHDR" + size + content[24:29]
        return content[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[33:], False
    return any_bytes(content, rng)


GRAMMARS: dict[str, Callable[[bytes, Rng], Damage]] = {
    "text": any_text,
    "table": table,
    "yaml": yaml,
    "json": json_text,
    "bytes": any_bytes,
    "cloud": cloud,
    "npz": npz,
    "npy": npy,
    "matlab": matlab,
    "image": image,
}
