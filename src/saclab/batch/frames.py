"""Messages between processes over a pipe: JSON and arrays, each with its length before it. Nothing is pickled."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import safetensors.numpy

from saclab.training.checkpoint import Arrays as Arrays

Message = tuple[dict[str, Any], Arrays]

LENGTHS = struct.Struct("<QQ")


def send(pipe: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a message; raises BrokenPipeError if nobody reads."""
    text = json.dumps(header).encode()
    blob = safetensors.numpy.save({name: np.array(array, order="C") for name, array in (arrays or {}).items()})
    content = memoryview(LENGTHS.pack(len(text), len(blob)) + text + blob)
    while content:
        content = content[os.write(pipe, content) :]


def receive(pipe: int) -> Message:
    """The next message; raises EOFError if nobody writes any more."""
    text_bytes, blob_bytes = LENGTHS.unpack(read_exactly(pipe, LENGTHS.size))
    header: dict[str, Any] = json.loads(read_exactly(pipe, text_bytes))
    arrays: Arrays = safetensors.numpy.load(read_exactly(pipe, blob_bytes))
    return header, arrays


def read_exactly(pipe: int, count: int) -> bytes:
    parts = []
    while count:
        part = os.read(pipe, min(count, 2**20))
        if not part:
            raise EOFError
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
