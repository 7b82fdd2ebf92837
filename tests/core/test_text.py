import pytest

from climatenerf.core.errors import UserError
from climatenerf.core.text import decode, lines_of, read_text


def test_a_byte_order_mark_is_left_out(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf\xc3\xbcber\r\n")
    assert read_text(path) == "über\r\n"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-32", "latin-1", "cp1252"])
def test_other_encodings_are_named_with_the_file(encoding):
    raw = "Straße\nöä\n".encode(encoding)
    with pytest.raises(UserError, match=r"poses\.txt has|poses\.txt is not text") as error:
        decode(raw, "poses.txt")
    if encoding in ("utf-16", "utf-32"):
        assert encoding.upper() in str(error.value)
    if encoding == "latin-1":
        assert "line 1" in str(error.value) and "UTF-8" in str(error.value)


def test_only_line_ends_split_lines():
    assert lines_of("a\r\nb\rc\nd\u2028e\x0bf\x85g") == ["a", "b", "c", "d\u2028e\x0bf\x85g"]
