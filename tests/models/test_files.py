"""Only regular files of bounded size are read, and whatever else an operator hands in is refused in a sentence, at
once."""

from __future__ import annotations

import io
import os
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.damage import _npz_bomb, _objects
from weldcal.models.array_files import read_grey_image, read_npy, read_npz
from weldcal.models.documents import DocumentSection, parse_document, read_document
from weldcal.models.errors import InputError
from weldcal.models.files import read_bytes, read_text, sha256

READERS: dict[str, Callable[[Path], object]] = {
    "bytes": read_bytes,
    "text": read_text,
    "hash": sha256,
    "npz": read_npz,
    "npy": read_npy,
    "document": read_document,
    "image": read_grey_image,
}


def refusal(read: Callable[[Path], object], path: Path) -> str:
    """The sentence, which must come within a second of computing time."""
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        read(path)
    assert time.process_time() - begin < 1.0
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "loop of links", "nothing", "link to a pipe"])
def test_only_a_regular_file_is_opened(tmp_path: Path, reader: str, kind: str) -> None:
    path = tmp_path / "a.npz"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "loop of links":
        path.symlink_to(path.name)
    elif kind == "link to a pipe":
        os.mkfifo(tmp_path / "p")
        path.symlink_to("p")
    words = {"pipe": "is a pipe", "folder": "is a folder", "device": "is a device", "nothing": "There is no file"}
    assert words.get(kind.removeprefix("link to a "), "cannot be opened") in refusal(READERS[reader], path)


def test_a_link_to_a_file_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("x")
    (tmp_path / "b.txt").symlink_to("a.txt")
    assert read_text(tmp_path / "b.txt") == "x"


def test_a_file_beyond_its_bound_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with path.open("wb") as stream:
        stream.truncate(100 * 1024**2)  # a hole: no bytes on the disk
    assert "larger than 64 MiB" in refusal(read_text, path)


@pytest.mark.parametrize(
    ("encoding", "sentence"),
    [
        ("utf-16", "it is UTF-16; save it as UTF-8"),
        ("utf-16-le", "null characters"),
        ("latin-1", "line 2 is not UTF-8"),
    ],
)
def test_another_encoding_is_named(tmp_path: Path, encoding: str, sentence: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes("a: 1\nnote: Gerät\n".encode(encoding))
    assert sentence in refusal(read_text, path)
    path.write_bytes("note: Gerät\n".encode("utf-8-sig"))
    assert read_text(path) == "note: Gerät\n"


def saved(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def members(**bodies: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, body in bodies.items():
            archive.writestr(f"{name}.npy", body)
    return stream.getvalue()


def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path) -> None:
    arrays = {
        "a": np.arange(12.0).reshape(3, 4), "b": np.asfortranarray(np.arange(6).reshape(2, 3)), "c": np.array("m"),
        "d": np.array([b"x", b"yz"]), "e": np.zeros((0, 3)), "f": np.array([True, False]), "g": np.arange(3, dtype=">i2"),
    }  # fmt: skip
    (tmp_path / "a.npz").write_bytes(saved(arrays))
    found = read_npz(tmp_path / "a.npz")
    assert set(found) == set(arrays)
    for name, value in arrays.items():
        assert found[name].dtype == value.dtype
        assert np.array_equal(found[name], value)
    assert set(read_npz(tmp_path / "a.npz", ("a", "z"))) == {"a"}
    np.save(tmp_path / "a.npy", arrays["a"])
    assert np.array_equal(read_npy(tmp_path / "a.npy"), arrays["a"])


LIAR = npy(np.zeros((4, 3))).replace(b"(4, 3)", b"(9, 3)")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (_npz_bomb("points.npy"), "would expand to 2400 MB"),
        (members(points=LIAR), "its header promises"),
        (members(points=_objects(np.zeros(3))), "object, not plain numbers"),
        (members(points=npy(np.zeros(3, dtype=[("a", "f8")]))), "not plain numbers"),
        (saved({"points": np.zeros((9, 3))})[:90], "is not an npz file, or damaged"),
        (b"PK\x03\x04 nothing", "is not an npz file, or damaged"),
    ],
    ids=["bomb", "lying header", "objects", "structured", "cut", "nothing"],
)
def test_an_npz_is_refused_before_it_is_expanded(tmp_path: Path, content: bytes, sentence: str) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    assert sentence in refusal(read_npz, tmp_path / "a.npz")
    assert not Path("executed").exists()


def test_an_array_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy(np.zeros(3)))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.npy", npy(np.ones(3)))
    assert "holds 'a' twice" in refusal(read_npz, tmp_path / "a.npz")


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "kind", "sentence"),
    [
        (LAUGHS, "YAML", "more than 1000000 values"),
        ("[" * 50_000, "YAML", "50 levels"),
        ("- " * 50_000, "YAML", "50 levels"),
        ("a: &a [*a]", "YAML", "levels"),
        ("a: 1\nb: 2\na: 3\n", "YAML", "key 'a' twice"),
        ('{"a": 1, "a": 2}', "JSON", "key 'a' twice"),
        ("[" * 200_000, "JSON", "cannot be read as JSON"),
        ("a: [1,", "YAML", "line 1"),
        ("!!python/object/apply:os.system [touch executed]", "YAML", "cannot be read as YAML"),
        ("", "YAML", "is empty"),
    ],
)
def test_a_document_without_end_or_with_two_answers_is_refused(text: str, kind: str, sentence: str) -> None:
    begin = time.process_time()
    with pytest.raises(InputError, match=sentence):
        parse_document("a", text, kind)
    assert time.process_time() - begin < 2.0
    assert not Path("executed").exists()


@dataclass(frozen=True, kw_only=True)
class Part:
    """A record of a file."""

    id: str
    used: bool
    axes: tuple[int, ...] = ()


def test_records_are_read_by_their_fields() -> None:
    d = DocumentSection.of("f.yaml", {"a": [{"id": "p", "used": False, "axes": [1, 2]}], "b": [{"id": "p"}]})
    assert d.records("a", Part) == (Part(id="p", used=False, axes=(1, 2)),)
    assert d.records("none", Part) == ()
    for wrong, sentence in (
        ({"id": "p"}, r"b\[0\]\.used is missing"),
        ({"id": 1, "used": True}, r"b\[0\]\.id must be a text"),
        ({"id": "p", "used": 1}, r"b\[0\]\.used must be true or false"),
        ({"id": "p", "used": True, "axes": [1, 0.5]}, r"b\[0\]\.axes\[1\] must be a whole number"),
        ({"id": "p", "used": True, "axis": []}, r"b\[0\]\.axis is not a known key: did you mean axes"),
    ):
        with pytest.raises(InputError, match=sentence):
            DocumentSection.of("f.yaml", {"b": [wrong]}).records("b", Part)


def test_a_value_of_the_wrong_kind_is_named_with_file_and_key() -> None:
    d = DocumentSection.of("f.yaml", {"a": {"n": "x", "big": 10**400, "list": [1, [2]], "yes": 1}, "s": [1]})
    a = d.section("a")
    for get, key in (
        (lambda: a.number("n"), "a.n must be a finite number"),
        (lambda: a.number("big"), "a.big must be a finite number"),
        (lambda: a.array("list", 2), "a.list must be 2 finite numbers"),
        (lambda: d.texts("s"), "s must be a list of texts"),
        (lambda: d.records("s", Part), r"s\[0\] must hold keys and values"),
        (lambda: d.section("s"), "s must be a mapping"),
    ):
        with pytest.raises(InputError, match=f"'f.yaml': {key}"):
            get()
