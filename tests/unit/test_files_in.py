"""Files from outside: what is no regular file, or too large, is refused in one line and without waiting."""

import gzip
import os

import pytest

from instrument.errors import FileError
from instrument.files_in import harmless, open_regular, read_regular


def told(call, *words):
    with pytest.raises(FileError) as caught:
        call()
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert text.isprintable(), text


def test_a_regular_file_is_read(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    with open_regular(tmp_path / "a", 5) as file:
        assert file.read() == b"12345"
    assert read_regular(str(tmp_path / "a"), 5) == b"12345"


def test_i5_a_pipe_does_not_block_and_a_device_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", "/dev/null"):
        told(lambda path=path: read_regular(path, 100), "is a pipe or a device", "into a file first")


def test_i5_a_sparse_file_counts_with_its_declared_size(tmp_path):
    with open(tmp_path / "s", "wb") as file:
        file.truncate(20_000_000_000)
    told(lambda: open_regular(tmp_path / "s", 10_000_000, "catalogue"), "catalogue", "20 GB", "10 MB")


def test_i5_a_file_that_does_not_say_its_size_stops_at_the_limit():
    told(lambda: read_regular("/proc/self/maps", 10), "larger than the 10 B")


def test_i5_a_gzip_bomb_stops_at_the_limit(tmp_path):
    (tmp_path / "b.gz").write_bytes(gzip.compress(bytes(10_000_000)))
    told(lambda: read_regular(tmp_path / "b.gz", 1_000_000, unzip=True), "unpacked", "1 MB")
    assert len(read_regular(tmp_path / "b.gz", 1_000_000)) < 20_000


def test_gzip_is_undone_in_all_its_members(tmp_path):
    (tmp_path / "a.gz").write_bytes(gzip.compress(b"one ") + gzip.compress(b"two") + bytes(20))
    assert read_regular(tmp_path / "a.gz", 100, unzip=True) == b"one two"


@pytest.mark.parametrize("damage", [lambda raw: raw[:-9], lambda raw: raw[:12] + b"\xff\xff\xff" + raw[15:]])
def test_damaged_gzip_is_told(tmp_path, damage):
    (tmp_path / "a.gz").write_bytes(damage(gzip.compress(b"something to be packed, and more of it" * 9)))
    told(lambda: read_regular(tmp_path / "a.gz", 1000, unzip=True), "a.gz", "gzip")


def test_what_is_not_there_is_told_in_one_line(tmp_path):
    told(lambda: open_regular(tmp_path / "none", what="catalogue"), "no catalogue '")
    told(lambda: open_regular(tmp_path), "is a folder")
    told(lambda: open_regular("a\0b"), r"a\x00b", "cannot be opened")
    told(lambda: open_regular("x" * 300), "cannot be opened", "too long")
    told(lambda: open_regular(tmp_path / "\x1b[2Jx"), r"\x1b[2Jx")


def test_i11_text_from_outside_is_escaped_and_cut():
    assert harmless("a\x1b[31mb\n\x07\u202e\udc80") == r"a\x1b[31mb\n\x07\u202e\udc80"
    assert harmless("Größe µ") == "Größe µ"
    assert harmless("0123456789", 8) == "01234..."
