"""Reads pickles of plain containers and NumPy numbers, and runs nothing that a pickle names.

A pickle is a program: it names functions and calls them. Here every name it may use is a stand-in
of this module, so neither foreign functions nor NumPy's own unpickling (which trusts what it is
given) ever run.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np

from emrld_jax.demos.archive import MAX_BYTES, DemoError

MAX_ITEMS = 10**6  # of nested lists; arrays are limited by the file's size


class _DType:
    """Stands in for numpy.dtype: numbers and booleans only."""

    def __init__(self, name: str | bytes, *_: object) -> None:
        self.dtype = np.dtype(name.decode("ascii") if isinstance(name, bytes) else str(name))
        if self.dtype.kind not in "biuf":
            raise DemoError(f"arrays of {self.dtype} are refused; only numbers are allowed")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        if state[1] in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Stands in for numpy.ndarray; `numpy.asarray` makes it a real one."""

    value: np.ndarray | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, data = state
        self.value = _from_buffer(data, dtype, shape, "F" if fortran else "C")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if self.value is None:
            raise DemoError("an array without contents")
        return np.array(self.value, dtype=dtype)


def _from_buffer(data: Any, dtype: _DType, shape: tuple[int, ...], order: Any) -> np.ndarray:
    return np.frombuffer(_as_bytes(data), dtype.dtype).reshape(shape, order=order)


def _as_bytes(data: Any) -> bytes:
    return data.encode("latin1") if isinstance(data, str) else bytes(memoryview(data))


def _reconstruct(*_: object) -> _Array:
    return _Array()


def _scalar(dtype: _DType, data: Any) -> Any:
    return np.frombuffer(_as_bytes(data), dtype.dtype)[0]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise DemoError(f"bytes encoded as {encoding!r} are refused; only latin1 is allowed")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Protocols 0 to 2 write empty bytes as a call of `bytes`; it takes no arguments here."""
    return b""


_ALLOWED = {
    ("builtins", "bytes"): _no_bytes,
    ("__builtin__", "bytes"): _no_bytes,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _encode,
    **{
        (f"{core}.{module}", name): stand_in
        for core in ("numpy.core", "numpy._core")
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _reconstruct),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _from_buffer),
        )
    },
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise DemoError(
                f"the pickle asks for {module}.{name}, which is refused (it may run anything); "
                "only NumPy arrays of numbers in dictionaries, lists and tuples are allowed"
            )
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise DemoError("the pickle refers to objects outside it, which is refused")


def read_pickle(path: Path, max_bytes: int = MAX_BYTES) -> Any:
    """What a pickle of plain containers and NumPy numbers holds; arrays go through `numpy.asarray`.

    Args:
        path: the file.
        max_bytes: the largest file that is read.

    Raises:
        DemoError: the file is missing, too large, broken, or asks for anything but NumPy numbers.
    """
    if not path.is_file():
        raise DemoError(f"{path}: there is no such file")
    if path.stat().st_size > max_bytes:
        raise DemoError(f"{path}: larger than {max_bytes} bytes")
    try:
        data = path.read_bytes()
        _check_numbers(data)
        return _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except DemoError as error:
        raise DemoError(f"{path}: {error}") from error
    except Exception as error:  # a broken pickle fails in any way it likes
        raise DemoError(
            f"{path}: not a whole pickle ({type(error).__name__}: {error}); allowed: a pickle, or "
            "an .npz file, in the layout of the paper's released demonstrations"
        ) from error


def _check_numbers(data: bytes) -> None:
    """Refuses entry numbers beyond the file's size: unpickling makes a table of that length."""
    for opcode, argument, _ in pickletools.genops(data):
        if "PUT" in opcode.name and isinstance(argument, int) and argument > len(data):
            raise DemoError(f"the pickle numbers an entry {argument}, more than it has bytes")


def count_items(value: Any, limit: int = MAX_ITEMS, depth: int = 4) -> int:
    """How many items nested lists have, counted to just above the limit.

    A small pickle can name one list many times over, which grows as a power when it is written out.
    """
    if not isinstance(value, list | tuple):
        return 1
    if depth == 0:
        return limit + 1
    total = 0
    for item in value:
        total += max(1, count_items(item, limit - total, depth - 1))
        if total > limit:
            break
    return total
