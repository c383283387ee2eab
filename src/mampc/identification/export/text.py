"""Rows of a text, whatever its encoding, between separators; and what a compressed file holds."""

from __future__ import annotations

import bz2
import codecs
import csv
import gzip
import io
import lzma
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

from mampc.base.errors import MampcError, shown
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import NOT_UTF_8, Row

FILE_LIMIT = 256 * 2**20  # bytes
KIND = "CSV, Excel, Parquet or JSON file"
CHUNK = 20_000  # rows parsed at a time
MARK = "\ufeff"  # of the order of bytes, inside a text where files were put together
BINARY = re.compile(rb"[\x00-\x08\x0e-\x19\x1c-\x1f]|\x1a(?!\s*$)")
COMPRESSED: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}
HIDDEN = re.compile(r"/$|(^|/)\.|^__MACOSX/")  # folders, and what systems put beside files
ZIP = b"PK\x03\x04", b"PK\x05\x06"
WORKBOOK = "[Content_Types].xml"  # in every Excel file, which is an archive too

DAMAGED = (
    OSError,
    EOFError,
    RuntimeError,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
)  # RuntimeError: locked

Rows: TypeAlias = Callable[[], Iterator[list[Row]]]  # all rows from the first on, in blocks


def unpacked(source: str | Path, content: bytes, findings: Findings) -> bytes:
    """The one file in a compressed file or an archive; anything else as it is.

    Raises:
        MampcError: several files, a damaged one, or one that unpacks to more than `FILE_LIMIT`.
    """
    packed = next((kind for start, kind in COMPRESSED.items() if content.startswith(start)), None)
    try:
        if packed is not None:
            with packed(io.BytesIO(content)) as file:
                content = file.read(FILE_LIMIT + 1)
        elif content.startswith(ZIP):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                names = [name for name in archive.namelist() if not HIDDEN.search(name)]
                if WORKBOOK in archive.namelist():
                    return content
                if len(names) != 1:
                    raise MampcError(
                        f"{source}: expected an archive of one file, received {len(names)}: {shown(names, 200)}; "
                        "unpack it and name the files"
                    )
                findings.note(f"{names[0]!r} read out of the archive")
                with archive.open(names[0]) as file:
                    content = file.read(FILE_LIMIT + 1)
    except DAMAGED as error:
        raise MampcError(f"{source}: expected a readable {KIND}, received when unpacked: {error}") from None
    if len(content) > FILE_LIMIT:
        raise MampcError(f"{source}: expected a {KIND} that unpacks to {FILE_LIMIT / 2**20:g} MiB at most")
    return content


def text_rows(content: bytes, encoding: str, separator: str, source: str | Path) -> Rows:
    """The rows of a text between separators."""
    marked = content.find(codecs.BOM_UTF8, 3) > 0

    def rows() -> Iterator[list[Row]]:
        text = io.TextIOWrapper(io.BytesIO(content), encoding=encoding, newline="")
        lines = (line.replace(MARK, "") for line in text) if marked else text
        reader = csv.reader(lines, delimiter=separator, skipinitialspace=separator == " ")
        try:
            while block := [(reader.line_num, row) for row in islice(reader, CHUNK)]:
                yield block
        except (csv.Error, UnicodeError) as error:
            raise MampcError(
                f"{source}: expected a readable {KIND}, received in row {reader.line_num}: {error}"
            ) from None

    return rows


def encoding_of(path: str | Path, content: bytes, named: str | None, findings: Findings) -> str:
    """The encoding of a text, as it is named or as its bytes show it; raises `MampcError` where it is no text."""
    if named is not None:
        try:
            "".encode(named)  # Python knows others, such as "hex", that are of no text
            return codecs.lookup(named).name
        except (LookupError, TypeError, ValueError):
            raise MampcError(f"encoding: expected one such as 'cp932', received {shown(named)}") from None
    if content[:4] in (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE):
        return "utf-32"
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    found, zeros = "", content[:2000].count(0)
    if zeros > len(content[:2000]) / 3:  # two bytes a letter of Latin scripts, without a mark of their order
        found = "utf-16-be" if content[0] == 0 else "utf-16-le"
        content = content[:65536].decode(found, "replace").encode("latin-1", "replace")
    if BINARY.search(content[:65536]):
        raise MampcError(f"{path}: expected a readable {KIND}, received something else")
    if found:
        return found
    try:
        for _ in io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig"):
            pass
    except UnicodeDecodeError:
        findings.note(NOT_UTF_8)
        return "cp1252" if not re.search(rb"[\x81\x8d\x8f\x90\x9d]", content) else "latin-1"
    return "utf-8-sig"
