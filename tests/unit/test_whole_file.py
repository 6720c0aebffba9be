"""A file is whole or not there."""

import pytest

from instrument.errors import InputError
from instrument.whole_file import whole_file


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), whole_file(target, overwrite=True) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    with whole_file(target, overwrite=True) as partial:
        partial.write_text("new")
    assert target.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_what_exists_is_not_overwritten_unless_asked(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(InputError, match=r"a.txt exists: give overwrite=True, or another name"), whole_file(target):
        raise AssertionError("nothing is done")
    assert target.read_text() == "old"
    with pytest.raises(InputError, match="exists: choose another name"), whole_file(tmp_path, overwrite=True):
        raise AssertionError("a folder is none")
    new = tmp_path / "b.txt"
    with pytest.raises(InputError, match=r"b.txt exists"), whole_file(new) as partial:
        partial.write_text("ours")
        new.write_text("theirs")  # it came meanwhile
    assert new.read_text() == "theirs"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]
