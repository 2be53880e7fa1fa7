"""Hostile versions of the files of a store, a policy and a run; each is a function of the sound file and a generator.

Most keep their checksums consistent, as somebody with ill intent would: what a checksum finds tests nothing behind it.
"""

import copy
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numcodecs.blosc import Blosc

from shared.io.documents import with_checksum
from tests.support.mutations import damaged, pick

T = TypeVar("T")
Rng = np.random.Generator

# fmt: off
VALUES = (
    None, True, False, 0, -1, 1, 2, 7, 2**31 - 1, -2**31, 2**32, 2**63 - 1, -2**63, 2**64, 10**15, 10**300, 1e308,
    -1e-308, 0.5,
    "", "x", "x" * 1000, "..", "/etc/passwd", "../../x", "a\nb", "\x1b[2J", "\u202e", "<b>", "=1+1", "nan", "ok",
    [], {}, [[]], [0], [{}], {"a": 1}, [None] * 300, ["x"] * 300,
)
RAW = (
    b"NaN", b"Infinity", b"1e999", b"-1e999", b"9" * 6000, b"[" * 300 + b"]" * 300, b"[" * 50_000, b'{"a":' * 50_000,
    b'"\\ud800"', b'"\\u0000"', b"0x10", b"01", b"'x'", b"[1,]", b"\xff", b"1 2",
)
LENGTHS = (0, 1, 2, 15, 16, 17, 255, 65535, 65536, 2**20, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1)
CELLS: tuple[Any, ...] = (
    float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, 1e-308, 0, -1, 1, 2**31 - 1, -2**31, 2**63 - 1, -2**63,
    "", "x", "x" * 201, "x" * 70_000, "\x1b[2J", "a\nb", "ok", "[" * 50_000, "{}", "[[]]", "[1]", '["a"]', "null",
)
DEFAULTS = (
    b'a = 1\n' * 2, b"[" * 5000, b"a = " + b"[" * 5000, b"a." * 20_000 + b"b = 1", b"x = 0x" + b"f" * 9000,
    b"x = " + b"9" * 9000, b"\xff\xfe", b"[[a]]\n" * 9000, b'seed = "x"', b"seed = 1e999", b"seed = -1",
    b'"a\\nb" = 1', b"seed = 1\nseed = 1", b"a = {" * 3000, b"[a]\n[a]", b"seed = nan", b"d = 9999-99-99",
)
# fmt: on


SEALS = ("manifest.json", "index.json", "policy.json")
"""Files that say what others must be."""


def noise(data: bytes, rng: Rng) -> bytes:
    """Up to four flips, cuts, repetitions, foreign bytes, and other lengths in place of a few bytes."""
    for _ in range(int(rng.integers(1, 5))):
        # The beginnings and ends of files say most about the rest.
        reach = pick(rng, (len(data), min(len(data), 64), len(data)))
        a, b = sorted(int(rng.integers(reach + 1)) for _ in range(2))
        if rng.random() < 0.3:
            a, b = len(data) - b, len(data) - a
        b = min(b, a + 200)
        match int(rng.integers(8)):
            case 5 | 6:
                width = pick(rng, (1, 4, 4, 8))
                number = pick(rng, (*LENGTHS, len(data), len(data) + 1, max(len(data) - 1, 0)))
                data = (
                    data[:a] + (number % 256**width).to_bytes(width, pick(rng, ("little", "big"))) + data[a + width :]
                )
            case kind:
                data = damaged(data, a, b, kind, rng)
    return data


def _spots(content: Any) -> list[tuple[Any, Any]]:
    """Every container in a JSON value, with each of its keys or indices."""
    spots: list[tuple[Any, Any]] = []
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        spots += [(content, key), *_spots(content[key])]
    return spots


def edited(content: Any, rng: Rng) -> Any:
    """A JSON value with one to three of its values changed, removed, moved or repeated."""
    content = json.loads(json.dumps(content))
    for _ in range(int(rng.integers(1, 4))):
        spots = _spots(content)
        if not spots:
            return copy.deepcopy(pick(rng, VALUES))
        holder, key = pick(rng, spots)
        other_holder, other_key = pick(rng, spots)
        match int(rng.integers(6)):
            case 0:
                del holder[key]
            case 1:
                holder[key] = json.loads(json.dumps(other_holder[other_key]))
            case 2 if isinstance(holder, dict):
                holder[pick(rng, ("x", "", "../x", "a\nb", "\x1b[2J", "shape", "schema_version"))] = copy.deepcopy(
                    pick(rng, VALUES)
                )
            case 2 | 3 if isinstance(holder, list):
                holder[:] = holder * pick(rng, (0, 2, 50))
            case 4 if isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
                holder[key] = holder[key] + pick(rng, (-1, 1, -(2**31), 2**31, 0.5))
            case _:
                holder[key] = copy.deepcopy(pick(rng, VALUES))
    return content


def edited_text(data: bytes, rng: Rng) -> bytes:
    """A JSON text with values changed, or with something that is no JSON in place of one."""
    if rng.random() < 0.7:
        return json.dumps(edited(json.loads(data), rng)).encode()
    marker = "MARKER"
    content = json.loads(data)
    spots = _spots(content)
    if not spots:
        return pick(rng, RAW)
    holder, key = pick(rng, spots)
    holder[key] = marker
    return json.dumps(content).encode().replace(f'"{marker}"'.encode(), pick(rng, RAW), 1)


def tensors_edited(data: bytes, rng: Rng) -> bytes:
    """A safetensors file whose header says something else, of a length that is or is not its own."""
    length = int.from_bytes(data[:8], "little")
    header = edited_text(data[8 : 8 + length], rng)
    if rng.random() < 0.3:
        told = json.loads(data[8 : 8 + length])
        entry = told[pick(rng, sorted(told.keys() - {"__metadata__"}))]
        entry["shape"] = pick(rng, ([2**32, 2**32], [0, 2**63], [2**63], [-1], [0], [], [1] * 70, [2**64, 0], [1.5]))
        entry["data_offsets"] = pick(rng, (entry["data_offsets"], [0, 0], [0, 2**63], [5, 1], [-1, 4], [0, len(data)]))
        entry["dtype"] = pick(rng, (entry["dtype"], "F64", "F8_E4M3", "BOOL", "X", "I64", "F16", "F4"))
        header = json.dumps(told).encode()
    if rng.random() < 0.1:
        header += b" " * pick(rng, (1, 7, 5_000_000))
    size = len(header) if rng.random() < 0.9 else pick(rng, LENGTHS)
    return size.to_bytes(8, "little") + header + data[8 + length :]


def table_edited(data: bytes, rng: Rng) -> bytes:
    """A Parquet file with other cells in a column, or of other kinds of pages."""
    table = pq.read_table(pa.BufferReader(data))
    for _ in range(int(rng.integers(0, 3))):
        index = int(rng.integers(table.num_columns))
        field = table.schema.field(index)
        cells = table.column(index).to_pylist()
        if not cells:
            continue
        for row in range(len(cells)) if rng.random() < 0.5 else [int(rng.integers(len(cells)))]:
            cell = pick(rng, CELLS)
            cells[row] = [cell] * pick(rng, (0, 1, len(cells[row]))) if isinstance(cells[row], list) else cell
        try:
            table = table.set_column(index, field, pa.array(cells, field.type))
        except (pa.ArrowException, TypeError, OverflowError, ValueError):
            continue
    if rng.random() < 0.2:
        table = table.take(pa.array(rng.permutation(len(table))))
    if rng.random() < 0.2:
        table = table.slice(0, int(rng.integers(len(table) + 1)))
    texts = [field.name for field in table.schema if field.type == pa.string()]
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        use_dictionary=pick(rng, (texts, texts, True, False)),
        compression=pick(rng, ("zstd", "zstd", "snappy", "none", "gzip", "brotli", "lz4")),
        data_page_version=pick(rng, ("1.0", "1.0", "2.0")),
        data_page_size=pick(rng, (1 << 20, 64)),
        write_statistics=bool(rng.random() < 0.2),
        row_group_size=pick(rng, (1 << 20, 1 << 20, 3)),
    )
    changed: bytes = sink.getvalue().to_pybytes()
    return noise(changed, rng) if rng.random() < 0.3 else changed


def chunk_edited(data: bytes, rng: Rng) -> bytes:
    """A chunk with another header, other numbers, or of another compressor."""
    if rng.random() < 0.5:
        place = int(rng.integers(16))
        width = pick(rng, (1, 4))
        number = pick(rng, (*LENGTHS, len(data), len(data) + 1, len(data) - 1)) % 256**width
        changed = data[:place] + number.to_bytes(width, "little") + data[place + width :]
        return changed if rng.random() < 0.7 else noise(changed, rng)
    numbers = np.frombuffer(Blosc().decode(data), np.uint8).copy()
    for _ in range(int(rng.integers(1, 50))):
        numbers[int(rng.integers(len(numbers)))] = pick(rng, (0, 1, 2, 127, 128, 255, 0x7C, 0x7E))
    codec = Blosc(
        cname=pick(rng, ("zstd", "lz4", "blosclz", "zlib")), clevel=pick(rng, (0, 1, 9)), shuffle=pick(rng, (0, 1, 2))
    )
    packed: bytes = codec.encode(numbers)
    return packed if rng.random() < 0.7 else packed[:16] + noise(packed[16:], rng)


def mutant_of(path: Path, data: bytes, rng: Rng) -> bytes:
    """A hostile version of a file, by what its name says it is."""
    if rng.random() < 0.25:
        return noise(data, rng)
    edit: Callable[[bytes, Rng], bytes] = noise
    if path.suffix == ".json":
        edit = edited_text
    elif path.suffix == ".parquet":
        edit = table_edited
    elif path.suffix == ".safetensors":
        edit = tensors_edited
    elif path.suffix == ".toml":
        edit = _toml_edited
    elif path.suffix == ".jsonl":
        edit = _line_edited
    elif path.name.startswith("c."):
        edit = chunk_edited
    return edit(data, rng)


def _toml_edited(data: bytes, rng: Rng) -> bytes:
    return pick(rng, DEFAULTS) + (b"\n" + data if rng.random() < 0.5 else b"")


def _line_edited(data: bytes, rng: Rng) -> bytes:
    lines = data.splitlines()
    number = int(rng.integers(len(lines)))
    lines[number] = edited_text(lines[number], rng)
    return b"\n".join(lines) + b"\n"


def vouch(root: Path, path: Path) -> None:
    """Make the checksums of a store's or a policy's other files agree with a changed one."""
    if path.name in ("manifest.json", "index.json", "store.json") or path.parent.name == "plans":
        _reseal(path)
        return
    data = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if path.name == "weights.safetensors":
        policy = path.with_name("policy.json")
        policy.write_text(json.dumps(json.loads(policy.read_bytes()) | {"weights_sha256": digest}))
        vouch(root, policy)
    for folder in path.relative_to(root).parents:
        for seal_file in (root / folder / "manifest.json", root / folder / "index.json"):
            if seal_file.is_file():
                document = json.loads(seal_file.read_bytes())
                document["files"][path.relative_to(seal_file.parent).as_posix()] = {"size": len(data), "sha256": digest}
                document.pop("sha256")
                seal_file.write_bytes(with_checksum(document))
                return


def _reseal(path: Path) -> None:
    try:
        document = json.loads(path.read_bytes())
        document.pop("sha256", None)
        path.write_bytes(with_checksum(document))
    except (ValueError, AttributeError, TypeError, RecursionError):
        return


def replace_by_no_file(path: Path, rng: Rng) -> None:
    """A folder, a pipe, or a link to elsewhere, to itself or to something endless in place of a file; or nothing."""
    path.unlink()
    match int(rng.integers(6)):
        case 0:
            path.mkdir()
        case 1:
            os.mkfifo(path)
        case 2:
            path.symlink_to("/etc/passwd")
        case 3:
            path.symlink_to(path.name)
        case 4:
            path.symlink_to("/dev/zero")


def remove(path: Path) -> None:
    """Remove whatever is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif path.exists() or path.is_symlink():
        path.unlink()
