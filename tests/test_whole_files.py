"""Files are written whole or not at all."""

import errno
import os
import stat
import threading

import pytest

from ctrlplan import _files
from ctrlplan._files import write_all, write_bytes, write_text

posix = pytest.mark.skipif(os.name != "posix", reason="permissions and links as POSIX has them")


def fail_at_flush(monkeypatch, error, after=0):
    """Let the flush to the disk fail, as a full disk does, after a number of files."""
    flush, calls = os.fsync, []

    def full(handle):
        calls.append(handle)
        if len(calls) > after:
            raise error
        flush(handle)

    monkeypatch.setattr(_files.os, "fsync", full)


def test_text_and_bytes_arrive_as_they_are(tmp_path):
    write_text(tmp_path / "a", "é\r\n\n")
    assert (tmp_path / "a").read_bytes() == b"\xc3\xa9\r\n\n"
    write_bytes(str(tmp_path / "a"), b"\x00\xff")
    assert (tmp_path / "a").read_bytes() == b"\x00\xff"
    assert os.listdir(tmp_path) == ["a"]


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "plan.json"
    path.write_text("before")
    fail_at_flush(monkeypatch, OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(OSError, match=r"No space left on device.*plan\.json") as caught:
        write_text(path, "after")
    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["plan.json"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1), MemoryError()])
def test_an_interruption_leaves_what_was_there(error, tmp_path, monkeypatch):
    (tmp_path / "a").write_text("before")
    fail_at_flush(monkeypatch, error)
    with pytest.raises(type(error)):
        write_text(tmp_path / "a", "after")
    assert (tmp_path / "a").read_text() == "before"
    assert os.listdir(tmp_path) == ["a"]


def test_of_several_files_none_is_replaced_where_one_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("before")
    fail_at_flush(monkeypatch, OSError(errno.ENOSPC, "full"), after=1)
    with pytest.raises(OSError, match="full"):
        write_all({tmp_path / "a": "after", tmp_path / "b": b"after"})
    assert (tmp_path / "a").read_text() == "before"
    assert os.listdir(tmp_path) == ["a"]


def test_text_that_is_no_unicode_writes_nothing(tmp_path):
    with pytest.raises(UnicodeEncodeError):
        write_text(tmp_path / "a", "\udcff")
    assert os.listdir(tmp_path) == []


def test_errors_name_the_file_that_was_meant(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write_text(tmp_path / "none" / "a", "")
    assert caught.value.filename == str(tmp_path / "none" / "a")
    for folder in (tmp_path, str(tmp_path)):
        with pytest.raises(IsADirectoryError):
            write_text(folder, "")
    with pytest.raises(IsADirectoryError):
        write_text("", "")


@posix
def test_permissions_are_those_that_open_would_leave(tmp_path):
    with open(tmp_path / "plain", "w"):
        pass
    write_text(tmp_path / "new", "")
    assert os.stat(tmp_path / "new").st_mode == os.stat(tmp_path / "plain").st_mode
    os.chmod(tmp_path / "new", 0o640)
    write_text(tmp_path / "new", "again")
    assert stat.S_IMODE(os.stat(tmp_path / "new").st_mode) == 0o640


@posix
def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("before")
    monkeypatch.setattr(_files.os, "access", lambda path, how: False)  # root may write everywhere
    with pytest.raises(PermissionError):
        write_text(tmp_path / "a", "after")
    assert (tmp_path / "a").read_text() == "before"


@posix
@pytest.mark.parametrize("there", [True, False])
def test_a_symbolic_link_stays_one(there, tmp_path):
    (tmp_path / "far").mkdir()
    if there:
        (tmp_path / "far" / "a").write_text("before")
    (tmp_path / "link").symlink_to(tmp_path / "far" / "a")
    write_text(tmp_path / "link", "after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "far" / "a").read_text() == "after"
    assert os.listdir(tmp_path / "far") == ["a"]


@posix
def test_a_pipe_is_written_in_place(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    found = []
    reader = threading.Thread(target=lambda: found.append((tmp_path / "pipe").read_text()))
    reader.start()
    write_text(tmp_path / "pipe", "text")
    reader.join()
    assert found == ["text"]
    assert stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)


@posix
def test_the_longest_name_is_a_name(tmp_path):
    write_text(tmp_path / ("a" * 255), "text")
    assert (tmp_path / ("a" * 255)).read_text() == "text"


def test_threads_that_write_one_file_leave_one_of_the_texts(tmp_path):
    texts = [str(k) * 100_000 for k in range(8)]
    threads = [threading.Thread(target=write_text, args=(tmp_path / "a", text)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "a").read_text() in texts
    assert os.listdir(tmp_path) == ["a"]
