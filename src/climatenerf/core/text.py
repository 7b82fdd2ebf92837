"""Reading of text files: UTF-8 with or without a byte order mark, with any line ends."""

import codecs
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.regular_files import check_regular

# Marks that other encodings begin with; the mark of UTF-32 begins with that of UTF-16.
_MARKS = {
    "UTF-32": (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE),
    "UTF-16": (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE),
}


def read_text(path: Path) -> str:
    """Read a text file as UTF-8; a byte order mark is left out.

    Raises:
        OSError: The file is absent or cannot be read.
        UserError: It is a pipe or a device, or its encoding is not UTF-8; the message names the
            encoding where it is certain.
    """
    check_regular(path)
    return decode(path.read_bytes(), str(path))


def decode(raw: bytes, where: str) -> str:
    """Decode UTF-8, with or without a byte order mark.

    Args:
        raw: The bytes.
        where: What they are, for the message.

    Raises:
        UserError: They are in another encoding.
    """
    for name, marks in _MARKS.items():
        if raw.startswith(marks):
            raise UserError(f"{where} has the encoding {name}; save it as UTF-8")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\0" in raw[:1024]:
            raise UserError(f"{where} is not text; restore or replace it") from error
        line = raw.count(b"\n", 0, error.start) + 1
        raise UserError(
            f"{where} has an encoding other than UTF-8 (line {line}, byte"
            f" 0x{raw[error.start]:02x}); save it as UTF-8"
        ) from error


def lines_of(text: str) -> list[str]:
    r"""Split a text at `\n`, `\r\n` and `\r` alone.

    `str.splitlines` also splits at characters that may occur in names, such as U+2028.
    """
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
