"""Keeps finished results in a file, where each is found by the hash of what it was computed from.

An interrupted or repeated command finds the finished results there and computes only the others. The file is
text. Its first line states the format, and the hash of what all its results were computed from. Each further
line is one result:

    <crc32, hex> <length> <sha256 of what the result was computed from> <the result in JSON>

Reasons for this format:

- A line is added at the end and is on disk before `add` returns, in about the time of one `fsync`. A process
  that is killed meanwhile leaves at most an incomplete last line, which the next process cuts off. A damaged
  line costs its own result only. An HDF5 file that is killed in mid-write, or damaged in one byte, may be
  lost as a whole. A file for each of thousands of small results is slow on the disks of a cluster.
- JSON keeps every float64 exactly. Arrays are kept as the base64 text of their bytes, so every bit and every
  type of number is kept, in less than half of the length of decimal numbers.
- Results are read from the file when they are needed, so memory does not grow with the file.
- Nothing in the file is executed.

Several processes may have the file open and add results at once: each addition locks the file, and first
reads what the others have added.
"""

from __future__ import annotations

import base64
import dataclasses
import fcntl
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bayeskin import storage
from bayeskin.errors import CannotWrite, InputError
from bayeskin.hashing import sha256_of

T = TypeVar("T")
FORMAT = b"bayeskin store 1"
REMEDY = "bayeskin needs a store that this command wrote (delete this file to start the work again)"


class Store:
    """Finished results in one file; a context manager, which several processes may have open at once.

    path : the file; it is made with its first result
    computed_from : all that the results of the file have in common, as values that `sha256_of` accepts
    say : receives a line about results that are damaged, and therefore will be computed again

    Opening it raises InputError when the file cannot be written, when it is of another format, and when its
    results were computed from something else. Such a file is unchanged.
    """

    def __init__(
        self, path: Path, computed_from: Any, say: Callable[[str], None] = lambda text: None
    ) -> None:
        self.path, self._say = path, say
        self._header = b"%s %s\n" % (FORMAT, sha256_of(computed_from).encode())

    def __enter__(self) -> Store:
        self._places, self._end = dict[bytes, tuple[int, int]](), 0
        self._file = _opened(self.path)
        try:
            with self._locked():
                return self
        except BaseException:
            self._file.close()
            raise

    def __exit__(self, *_: object) -> None:
        try:
            if not self._end:
                with self._locked():
                    if not self._end:
                        self.path.unlink()
        finally:
            self._file.close()

    def __contains__(self, computed_from: Any) -> bool:
        return sha256_of(computed_from).encode() in self._places

    def add(self, computed_from: Any, result: Any) -> None:
        """Adds a result: a dataclass or a mapping, whose values are arrays and values of JSON.

        Raises InputError where it cannot be written; the file is then unchanged.
        """
        address = sha256_of(computed_from).encode()
        fields = vars(result) if dataclasses.is_dataclass(result) else result
        text = json.dumps(fields, default=_in_json).encode()
        content = b"%s %s" % (address, text)
        line = b"%08x %d %s\n" % (zlib.crc32(content), len(content), content)
        with self._locked():
            self._append(line)
            self._places[address] = (self._end - 1 - len(text), len(text))

    def read(self, computed_from: Any, kind: type[T]) -> T:
        """Returns the result that was computed from these values, as a dataclass `kind` or as a dict.

        Raises KeyError where there is none, and InputError where it is no result of this kind.
        """
        start, length = self._places[sha256_of(computed_from).encode()]
        try:
            fields = json.loads(os.pread(self._file.fileno(), length, start), object_hook=_from_json)
            if kind is dict:
                return kind(**fields)
            values = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
            return storage.checked(kind(**values), self.path)
        except (AttributeError, TypeError, ValueError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{self.path}, byte {start}", f"this line does not describe a {kind.__name__}", REMEDY
            ) from None

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Keeps other processes out of the file, after reading what they have added since the last time.

        The system removes the lock when a process ends.
        """
        while True:
            _lock(self._file, self.path)
            if self._end or _is_at(self._file, self.path):
                break
            self._file.close()  # another process had no results either, and has removed the file
            self._file = _opened(self.path)
        try:
            self._read_on()
            yield
        finally:
            fcntl.flock(self._file, fcntl.LOCK_UN)

    def _append(self, line: bytes) -> None:
        """Writes a line, completely or not at all."""
        text = line if self._end else self._header + line
        left = memoryview(text)
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except BaseException as error:
            self._file.truncate(self._end)
            if isinstance(error, OSError):
                raise CannotWrite(self.path, error) from None
            raise
        self._end += len(text)

    def _read_on(self) -> None:
        """Finds the results that follow those found before, and cuts off an incomplete end."""
        damaged = 0
        with open(self._file.fileno(), "rb", closefd=False) as lines:
            lines.seek(self._end)
            if not self._end:
                self._end = self._length_of_header(lines)
            for line in lines:
                if not line.endswith(b"\n"):
                    break
                self._end += len(line)
                if (content := _content_of_whole_line(line[:-1])) is None:
                    damaged += 1
                else:
                    address, _, text = content.partition(b" ")
                    self._places[address] = (self._end - 1 - len(text), len(text))
        if os.fstat(self._file.fileno()).st_size > self._end:
            self._file.truncate(self._end)
            damaged += 1
        if damaged:
            what = "a result is" if damaged == 1 else f"{damaged} results are"
            self._say(f"{self.path}: {what} damaged, and computed again where needed")

    def _length_of_header(self, lines: BufferedReader) -> int:
        """Returns the length of the first line, and 0 where it is incomplete."""
        first = lines.readline(len(self._header))
        if not self._header.startswith(first):
            known = first.startswith(FORMAT + b" ")
            problem = (
                "its results were computed from other inputs" if known else "it is not a store of results"
            )
            raise InputError(self.path, problem, REMEDY)
        return len(first) if first == self._header else 0


def _content_of_whole_line(line: bytes) -> bytes | None:
    """Returns the address and the JSON of a complete line, and None for a damaged line."""
    head, _, rest = line.partition(b" ")
    length, _, content = rest.partition(b" ")
    if length != b"%d" % len(content) or head != b"%08x" % zlib.crc32(content):
        return None
    return content


def _in_json(value: Any) -> Any:
    """Returns a value of JSON for a value that JSON does not have."""
    if isinstance(value, np.ndarray):
        text = base64.b64encode(value.tobytes()).decode()
        return {"base64": text, "dtype": value.dtype.str, "shape": value.shape}
    if isinstance(value, np.generic):
        return value.item()
    return dict(value)


def _from_json(plain: Mapping[str, Any]) -> Any:
    """Returns the array of a mapping that `_in_json` made of it, and any other mapping unchanged."""
    if plain.keys() != {"base64", "dtype", "shape"}:
        return plain
    dtype = np.dtype(plain["dtype"])
    if dtype.kind not in "biuf":
        raise ValueError(f"an array of {dtype}")
    return np.frombuffer(base64.b64decode(plain["base64"], validate=True), dtype).reshape(plain["shape"])


def _opened(path: Path) -> FileIO:
    """Opens a file for reading and appending, and makes it and its folder where they do not exist."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return FileIO(path, "a+")
    except OSError as error:
        raise CannotWrite(path, error) from None


def _lock(file: FileIO, path: Path) -> None:
    """Waits until no other process has locked the file, and locks it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
    except OSError as error:
        raise CannotWrite(path, error) from None


def _is_at(file: FileIO, path: Path) -> bool:
    """Returns whether an open file has not been removed from its path."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    return False
