"""A file that is written whole holds the old content or the new one, whoever else writes it."""

import os

import pytest

from iblf_jax.core.whole_files import written_whole


@pytest.fixture
def path(tmp_path):
    """A file with the greatest length of a name, which exists."""
    path = tmp_path / ("n" * 255)
    path.write_bytes(b"old")
    yield path
    assert list(tmp_path.iterdir()) == [path]


def test_the_content_is_on_the_disk_before_it_is_in_its_place(path, monkeypatch):
    synchronised = []

    def fsync(number):
        assert path.read_bytes() == b"old"
        synchronised.append(os.fstat(number).st_size)

    monkeypatch.setattr(os, "fsync", fsync)
    with written_whole(path) as file:
        file.write(b"the new content")
    assert synchronised == [15]
    assert path.read_bytes() == b"the new content"


def test_two_writers_do_not_mix(path):
    with written_whole(path) as one, written_whole(path) as other:
        one.write(b"one")
        other.write(b"the other")
    assert path.read_bytes() == b"one"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_write_leaves_what_was_there(path, error):
    def write():
        with written_whole(path) as file:
            file.write(b"half")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_bytes() == b"old"


def test_a_new_file_has_the_permissions_of_the_user(tmp_path):
    with written_whole(tmp_path / "whole") as file:
        file.write(b"")
    (tmp_path / "usual").write_bytes(b"")
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "usual").stat().st_mode


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_what_is_no_file_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with written_whole(pipe) as file:
        file.write(b"content")
    assert os.read(reader, 100) == b"content"
    os.close(reader)
    assert pipe.is_fifo()
