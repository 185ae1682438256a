"""Files appear whole or not at all."""

from __future__ import annotations

import pytest

from fdnt_xp.data.files import check_writable, make_folder, new_file
from fdnt_xp.errors import CatalogError


def test_the_file_appears_when_the_block_ends(tmp_path):
    with new_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("whole")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        assert not (tmp_path / "a.txt").exists()
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "whole"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("existing", [False, True])
def test_an_interrupt_leaves_nothing_behind(error, existing, tmp_path):
    target = tmp_path / "a.txt"
    if existing:
        target.write_text("old")

    def write_half():
        with new_file(target, overwrite=True) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert [file.name for file in tmp_path.iterdir()] == (["a.txt"] if existing else [])
    assert not existing or target.read_text() == "old"


def test_a_system_error_is_reported_as_ours(tmp_path):
    def fill_the_disk():
        with new_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(CatalogError, match=r"cannot write .*a\.txt: No space left on device"):
        fill_the_disk()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_kept(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(CatalogError, match=r"exists; .*--overwrite"), new_file(target):
        pytest.fail("the block must not run")
    with new_file(target, overwrite=True) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    def write_while_another_does():
        with new_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("ours")
            (tmp_path / "a.txt").write_text("theirs")

    with pytest.raises(CatalogError, match="exists"):
        write_while_another_does()
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "theirs"


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CatalogError, match="does not exist"):
        check_writable(tmp_path / "no" / "a.txt")
    with pytest.raises(CatalogError, match="is not a folder"):
        check_writable(tmp_path / "file" / "a.txt")
    with pytest.raises(CatalogError, match="it is a folder"):
        check_writable(tmp_path, overwrite=True)
    with pytest.raises(CatalogError, match="cannot make the folder"):
        make_folder(tmp_path / "file" / "folder")
    assert make_folder(tmp_path / "a" / "b").is_dir()
