"""A store of finished results: it gives back what it was given, and a damaged line costs that result only."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toys import worker_functions
from toys.full_disk import files_at_most

from bayeskin.errors import InputError
from bayeskin.execution.local import run_parallel
from bayeskin.hashing import sha256_of
from bayeskin.store import Store
from bayeskin.types import Array


@dataclass(frozen=True)
class Result:
    """A result as the package keeps them."""

    force_n: Array
    names: tuple[str, ...]
    ok: bool
    seconds: float


EDGE = np.array([[1.0 / 3.0, -0.0, np.inf], [np.nan, 5e-324, 1.7976931348623157e308]])
FIRST = Result(EDGE, ("E_c", "é\n"), True, 0.1)
SECOND = Result(np.zeros((0, 3)), (), False, float("nan"))
SHARED = {"model": "toy", "edges_s": np.arange(3.0)}


def same(result: Result, expected: Result) -> bool:
    """Equal bit by bit."""
    np.testing.assert_array_equal(result.force_n.view(np.int64), expected.force_n.view(np.int64))
    return repr(result) == repr(expected)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with two results."""
    with Store(tmp_path / "a.store", SHARED) as store:
        store.add({"E_c": 1e5}, FIRST)
        store.add([2, "b"], SECOND)
    return tmp_path / "a.store"


def kept(path: Path, heard: list[str] | None = None) -> list[bool]:
    """Returns whether the store has the first and the second result unchanged."""
    with Store(path, SHARED, (heard if heard is not None else []).append) as store:
        return [key in store and same(store.read(key, Result), result)
                for key, result in (({"E_c": 1e5}, FIRST), ([2, "b"], SECOND))]  # fmt: skip


def test_a_store_gives_back_to_the_last_bit_what_it_was_given(path: Path) -> None:
    assert kept(path) == [True, True]
    arrays = {kind: np.arange(6).reshape(2, 3).astype(kind) for kind in ("f4", ">f8", "i2", "u8", "?")}
    plain: dict[str, Any] = {"runs": 3, "fit": {"theta": {"E_c": 0.1}, "nested": [1, None]}, "note": "é\n"}
    with Store(path, SHARED) as store:
        assert ("absent" in store, sha256_of([2, "b"]) in store) == (False, False)
        with pytest.raises(KeyError):
            store.read("absent", dict)
        store.add("arrays", arrays | plain | {"number": np.float32(0.5), "flag": np.True_})
    with Store(path, SHARED) as store:
        read = store.read("arrays", dict)
    for kind, array in arrays.items():
        np.testing.assert_array_equal(read[kind], array)
        assert read[kind].dtype == np.dtype(kind)
    assert {name: read[name] for name in plain} == plain
    assert (read["number"], read["flag"]) == (0.5, True)


def test_a_store_without_results_leaves_no_file(tmp_path: Path) -> None:
    with Store(tmp_path / "folder" / "a.store", SHARED):
        pass
    assert list((tmp_path / "folder").iterdir()) == []


def test_a_store_cut_at_any_byte_keeps_the_whole_lines_and_can_be_continued(path: Path) -> None:
    text = path.read_bytes()
    header, first, _ = (len(line) for line in text.splitlines(keepends=True))
    for cut in range(len(text)):
        path.write_bytes(text[:cut])
        heard: list[str] = []
        assert kept(path, heard) == [cut >= header + first, False]
        incomplete = cut not in (0, header, header + first)
        assert heard == [f"{path}: a result is damaged, and computed again where needed"] * incomplete
        with Store(path, SHARED) as store:
            store.add([2, "b"], SECOND)
        assert kept(path) == [cut >= header + first, True]


def test_a_flipped_bit_costs_its_result_only(path: Path) -> None:
    text = path.read_bytes()
    header, first, _ = (len(line) for line in text.splitlines(keepends=True))
    for at in range(len(text) - 1):
        path.write_bytes(text[:at] + bytes([text[at] ^ 1]) + text[at + 1 :])
        if at < header:
            with pytest.raises(InputError, match=r"a\.store: (its results|it is not a store)"):
                kept(path)
            continue
        heard: list[str] = []
        results = kept(path, heard)
        assert heard == [f"{path}: a result is damaged, and computed again where needed"]
        if at != header + first - 1:  # without the line's end, both results are gone
            assert results == [at >= header + first, at < header + first]


def test_results_of_other_inputs_are_refused_and_stay(path: Path) -> None:
    before = path.read_bytes()
    with (
        pytest.raises(InputError, match="results were computed from other inputs"),
        Store(path, {**SHARED, "model": "another"}),
    ):
        pass
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "contents",
    [
        b"\x89HDF\r\n\x1a\n" + bytes(2000),
        b"no line's end",
        b'0a1b2c3d 2 {}\n{"task": 1}\n',
        b"bayeskin store 2 0\n",
    ],
)
def test_files_of_another_origin_and_of_another_version_are_refused_and_stay(
    tmp_path: Path, contents: bytes
) -> None:
    path = tmp_path / "b.store"
    path.write_bytes(contents)
    with pytest.raises(InputError, match=r"b\.store: it is not a store of results"):
        kept(path)
    assert path.read_bytes() == contents


@pytest.mark.parametrize(
    "text",
    [
        b"{", b"[]", b"3", b"[" * 9999, b"{}", b'{"force_n": 1, "names": [], "ok": true, "seconds": 1.0}',
        b'{"force_n": {"base64": "AAA=", "dtype": "<f8", "shape": [1]}, "names": [], "ok": 1, "seconds": 1}',
        b'{"force_n": {"base64": "", "dtype": "O", "shape": [0]}, "names": [], "ok": true, "seconds": 1}',
    ],
)  # fmt: skip
def test_a_line_with_the_right_checksum_that_is_no_result_is_refused(path: Path, text: bytes) -> None:
    content = sha256_of([2, "b"]).encode() + b" " + text
    with open(path, "ab") as file:
        file.write(b"%08x %d %s\n" % (zlib.crc32(content), len(content), content))
    with pytest.raises(InputError, match=r"a\.store"):
        kept(path)


def test_an_addition_finds_what_other_processes_have_added(path: Path) -> None:
    heard: list[str] = []
    with Store(path, SHARED) as first, Store(path, SHARED, heard.append) as other:
        first.add("a", {"force_n": EDGE})
        with open(path, "ab") as file:
            file.write(b"what a killed process was writing")
        other.add("b", {"force_n": EDGE + 1.0})
        first.add("c", {"force_n": EDGE + 2.0})
        assert ["a" in other, "c" in other, "b" in first] == [True, False, True]
        np.testing.assert_array_equal(first.read("b", dict)["force_n"], EDGE + 1.0)
    assert len(heard) == 1
    assert kept(path, heard) == [True, True]
    assert len(heard) == 1


def test_a_store_that_another_process_left_without_results_is_made_again(tmp_path: Path) -> None:
    path = tmp_path / "a.store"
    with Store(path, SHARED) as store:
        with Store(path, SHARED):
            pass
        assert not path.exists()
        store.add({"E_c": 1e5}, FIRST)
    assert kept(path) == [True, False]


def test_several_processes_add_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.store"
    numbers = [int(number) for _, number in run_parallel(worker_functions.added, [str(path)] * 3, 3)]
    with Store(path, "shared") as store:
        for number in numbers:
            for n in range(worker_functions.ADDED):
                np.testing.assert_array_equal(store.read([number, n], dict)["force_n"], np.full(3000, n))
    assert len(path.read_bytes().splitlines()) == 1 + 3 * worker_functions.ADDED


@pytest.mark.parametrize("room", [0, 10, 200])
def test_a_full_disk_is_told_and_costs_the_new_result_only(path: Path, room: int) -> None:
    before = path.read_bytes()
    with Store(path, SHARED) as store:
        with (
            files_at_most(len(before) + room),
            pytest.raises(InputError, match="cannot write"),
        ):
            store.add("large", {"force_n": np.ones(1000)})
        assert "large" not in store
        assert path.read_bytes() == before
        store.add("small", {"force_n": np.ones(1)})
    assert kept(path) == [True, True]


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place in (tmp_path, tmp_path / "file" / "a.store"):
        with pytest.raises(InputError, match="cannot write"):
            kept(place)
