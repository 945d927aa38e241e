"""Damages text files by the grammar of their format: tables, YAML, JSON, and text of any kind."""

import json
import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

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
        return _bomb(rng), False
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


def _bomb(rng: Rng) -> bytes:
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
    """A tree with a value of another type, ragged lists, missing or doubled keys; or text that ends early."""
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


GRAMMARS: dict[str, Callable[[bytes, Rng], Damage]] = {
    "text": any_text,
    "table": table,
    "yaml": yaml,
    "json": json_text,
}
