"""Reads .npz files without trusting them: no pickles, no memory for what a header only claims."""

from __future__ import annotations

import zipfile
import zlib
from math import prod
from pathlib import Path

import numpy as np

MAX_BYTES = 256 * 2**20  # all arrays of a file together, decompressed

_BROKEN = (zipfile.BadZipFile, zlib.error, ValueError, TypeError, EOFError, OSError, RuntimeError)


class DemoError(ValueError):
    """A demonstration file is refused; the message names the file, the key and what is allowed."""


def read_npz(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """All arrays of an .npz file, by key.

    Args:
        path: the file.
        max_bytes: what the arrays may take together, decompressed.

    Raises:
        DemoError: the file is missing, not an .npz, truncated, too large, or holds pickled objects.
    """
    if not path.is_file():
        raise DemoError(f"{path}: there is no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_members(path, members, max_bytes)
            return {
                member.filename.removesuffix(".npy"): _read_array(path, archive, member)
                for member in members
            }
    except DemoError:
        raise
    except _BROKEN as error:
        raise DemoError(f"{path}: not a whole .npz file ({error})") from error


def _check_members(path: Path, members: list[zipfile.ZipInfo], max_bytes: int) -> None:
    names = [member.filename for member in members]
    for name in names:
        if not name.endswith(".npy") or names.count(name) > 1:
            raise DemoError(f"{path}: {name!r} is not an array of its own (one .npy for each key)")
    total = sum(member.file_size for member in members)
    if total > max_bytes:
        raise DemoError(f"{path}: its arrays take {total} bytes; at most {max_bytes} are allowed")


def _read_array(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array; its header must agree with the member's size before anything is allocated."""
    key = member.filename.removesuffix(".npy")
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise DemoError(f"{path}: {key} has .npy version {version}; 1.0 and 2.0 are allowed")
        shape, fortran, dtype = read_header(file)
        if dtype.hasobject:
            raise DemoError(f"{path}: {key} holds pickled Python objects, which are never loaded")
        expected = prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or expected != member.file_size - file.tell():
            raise DemoError(
                f"{path}: {key} does not hold the {shape} {dtype} that its header claims"
            )
        data = file.read()
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
