"""A file is there whole or not at all; what is no file stays what it is."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from bench.base.files import write_whole


def test_a_device_or_pipe_is_written_to_and_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDWR)  # both ends, so that nobody waits for the other
    try:
        write_whole(pipe, "result\n")
        assert os.read(end, 100) == b"result\n"
    finally:
        os.close(end)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "true").write_text("before", encoding="utf-8")
    (tmp_path / "link").symlink_to(tmp_path / "true")
    write_whole(tmp_path / "link", "after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "true").read_text(encoding="utf-8") == "after"


def test_what_cannot_be_written_is_named_and_leaves_no_half(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="folder"):
        write_whole(tmp_path / "folder" / "r.json", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_whole(tmp_path / "folder", "x")
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no name that a file can have") as refused:
        write_whole(tmp_path / "a\ud800", "text")
    assert "\ud800" not in str(refused.value)


def test_a_pipe_that_nobody_reads_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="a pipe that nobody reads"):
        write_whole(tmp_path / "pipe", "text")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_whole(tmp_path / "pipe", "text")
    assert os.read(reader, 100) == b"text"
    os.close(reader)
