"""Files of float32 tensors in the safetensors format, read and written with NumPy alone.

The layout (github.com/huggingface/safetensors): a length of 8 bytes (little endian); so many bytes
of JSON, which give each tensor's type, shape and place, and texts under `__metadata__`; then the
tensors' bytes, little endian, row after row, without gaps. Nothing in a file is believed: no memory
is taken for what it only claims.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from bridges.messages import BridgeError

MAX_HEADER = 2**20  # bytes
MAX_DIMENSIONS = 8
METADATA = "__metadata__"

Tensors = dict[str, np.ndarray]
_DTYPE = "<f4"


class Contents(NamedTuple):
    """What a file holds."""

    metadata: dict[str, str]
    tensors: Tensors  # float32, read-only


def to_bytes(metadata: Mapping[str, str], tensors: Tensors) -> bytes:
    """The file's bytes: tensors by name, and a header that ends at a multiple of 8 bytes."""
    header: dict[str, Any] = {METADATA: dict(metadata)}
    parts, end = [], 0
    for name in sorted(tensors):
        part = tensor_bytes(tensors[name])
        offsets = [end, end + len(part)]
        header[name] = {
            "dtype": "F32",
            "shape": list(tensors[name].shape),
            "data_offsets": offsets,
        }
        parts.append(part)
        end += len(part)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return b"".join([len(text).to_bytes(8, "little"), text, *parts])


def tensor_bytes(tensor: np.ndarray) -> bytes:
    """A tensor's numbers as a file holds them."""
    return np.ascontiguousarray(tensor, _DTYPE).tobytes()


def from_bytes(data: bytes) -> Contents:
    """What a file's bytes say.

    Raises:
        BridgeError: they are cut off, damaged or no such file; says what is wrong.
    """
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > len(data) - 8:
        raise BridgeError("it is cut off, or no safetensors file")
    if length > MAX_HEADER:
        raise BridgeError(f"its header has {length} bytes; at most {MAX_HEADER} are allowed")
    header = parse_json(data[8 : 8 + length], "its header")
    metadata = header.pop(METADATA, {})
    if not isinstance(metadata, dict) or not all(isinstance(x, str) for x in metadata.values()):
        raise BridgeError(f"its header's {METADATA} must hold texts alone")
    places = {name: _place(name, entry) for name, entry in header.items()}
    _check_places(places, len(data) - 8 - length)
    body = memoryview(data)[8 + length :]
    tensors = {
        name: np.frombuffer(body[place.begin : place.end], _DTYPE).reshape(place.shape)
        for name, place in places.items()
    }
    return Contents(metadata, tensors)


def parse_json(text: bytes | str, where: str) -> dict[str, Any]:
    """A JSON object in which no name is given twice and every number is finite.

    Raises:
        BridgeError: it is no such text; `where` says which.
    """
    try:
        value = json.loads(
            text if isinstance(text, str) else text.decode(),
            object_pairs_hook=_unique,
            parse_constant=_finite,
            parse_float=_finite,
        )
    except (ValueError, RecursionError) as error:
        raise BridgeError(f"{where} is not JSON ({error})") from error
    if not isinstance(value, dict):
        raise BridgeError(f"{where} is not a JSON object")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name is given twice")
    return found


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


class _Place(NamedTuple):
    shape: tuple[int, ...]
    begin: int  # bytes after the header
    end: int


def _place(name: str, entry: Any) -> _Place:
    """Where a tensor is, as its entry in the header says."""
    keys = {"dtype", "shape", "data_offsets"}
    if not isinstance(entry, dict) or entry.keys() != keys:
        raise BridgeError(f"its header must give dtype, shape and data_offsets of {name!r}")
    if entry["dtype"] != "F32":
        raise BridgeError(f"{name!r} has dtype {entry['dtype']!r}; only 'F32' is allowed")
    shape, offsets = entry["shape"], entry["data_offsets"]
    whole = all(
        isinstance(x, list) and all(type(i) is int and i >= 0 for i in x) for x in (shape, offsets)
    )
    if not whole or len(shape) > MAX_DIMENSIONS or len(offsets) != 2:
        raise BridgeError(f"{name!r}: shape and data_offsets must be lists of whole numbers")
    if 0 in shape:  # whose other sizes could be any
        raise BridgeError(f"{name!r} is empty")
    if offsets[1] - offsets[0] != 4 * math.prod(shape):
        raise BridgeError(f"{name!r} does not have the bytes of its shape")
    return _Place(tuple(shape), *offsets)


def _check_places(places: Mapping[str, _Place], size: int) -> None:
    """The tensors must fill the file's bytes, without gaps and without sharing any."""
    end = 0
    for name, place in sorted(places.items(), key=lambda item: item[1][1:]):
        if place.begin != end:
            raise BridgeError(f"{name!r} does not begin where the tensor before it ends")
        end = place.end
    if end != size:
        raise BridgeError(f"its tensors have {end} bytes, but {size} follow its header")
