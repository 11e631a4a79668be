"""Text from outside does not act where it leaves; files that are none are not waited for."""

import io
import json
import os
import socket
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rich.text import Text

from bench.base.files import from_text, read_given, read_json, read_regular, to_text, write_whole
from bench.base.tables import Screen, as_html, table
from bench.base.text import as_typed, cause_of, in_json, visible

ACTS = ["\x1b[2J", *"\x07\x00\x7f\x9b\u202e\u2066\u2028\ufeff\ud800\r\U000e0041"]


@pytest.mark.parametrize("text", ACTS)
def test_what_acts_becomes_an_escape(text):
    shown = visible(f"a{text}b")
    assert shown.isprintable()
    assert shown.isascii()
    assert visible(shown) == shown


@pytest.mark.parametrize(
    ("name", "typed"),
    [
        ("unit-17", "unit-17"),
        ("-a b.csv", "'./-a b.csv'"),
        ("it's.csv", "'it'\"'\"'s.csv'"),
        ("мій", "'мій'"),
    ],
)
def test_a_name_in_a_command_can_be_pasted(name, typed):
    assert as_typed(name) == typed


def test_what_people_write_stays():
    text = "µ Δg ≤ 3·10⁻⁴ g\tℓ = 1\u202fm\r\n日本 🎉 \u200d é\n"
    assert visible(text) == text == in_json(text)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (KeyError("time"), "'time' is missing"),
        (TypeError("'int' object is not iterable"), "a value of the wrong type"),
        (PermissionError(13, "Permission denied", "a.json"), "Permission denied"),
        (ValueError("format 2"), "format 2"),
    ],
)
def test_a_cause_has_no_words_of_python(error, words):
    assert cause_of(error) == words


@pytest.mark.parametrize("text", ACTS)
def test_json_has_it_escaped_and_reads_back(text):
    written = to_text({"name": text, text: 1})
    assert visible(written) == written
    assert json.loads(written.encode()) == {"name": text, text: 1}


@pytest.mark.parametrize("terminal", [False, True])
def test_a_screen_shows_it_and_keeps_its_own_colours(terminal):
    file = io.StringIO()
    screen = Screen(
        file=file,
        highlight=False,
        force_terminal=terminal,
        width=200,
        color_system="standard" if terminal else None,
    )
    rows = table("name")
    rows.add_row("evil\x1b]0;title\x07\u202e")
    for what in ("a\x1b[2Jb", Text("c\x9bd\ud800", style="bold"), rows):
        screen.print(what)
    out = file.getvalue()
    assert r"a\x1b[2Jb" in out
    assert r"c\x9bd\ud800" in out
    assert r"evil\x1b]0;title" in out
    assert ("\x1b[1m" in out) is terminal
    assert visible(out.replace("\x1b[1m", "").replace("\x1b[0m", "")) == out.replace("\x1b[1m", "").replace(
        "\x1b[0m", ""
    )


def test_a_notebook_shows_it():
    rows = table("a\x1b")
    rows.add_row("<b>\u202e")
    page = as_html(["c\x9b"], rows)
    assert visible(page) == page
    assert "&lt;b&gt;" in page


@pytest.mark.parametrize(
    "text", ['{"a": NaN}', "[Infinity]", "[-Infinity]", '{"a": 1, "a": 2}', "[" * 100_000, "", "{"]
)
def test_what_is_not_json_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"."):
        from_text(text)


def test_only_regular_files_are_read_and_nothing_is_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        for path, why in ((tmp_path / "pipe", "pipe"), (tmp_path / "s", "socket"), (tmp_path, "folder")):
            with pytest.raises(OSError, match=why):
                read_regular(path, 10)
    with pytest.raises(OSError, match="device"):
        read_regular(tmp_path.joinpath("/dev/zero"), 10)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "a\0b", 10)
    (tmp_path / "file").write_bytes(b"0123456789")
    assert read_regular(tmp_path / "file", 10) == b"0123456789"
    with pytest.raises(OSError, match="more than"):
        read_regular(tmp_path / "file", 9)


def test_a_pipe_is_read_where_somebody_writes_to_it_and_not_waited_for_where_nobody_does(tmp_path):
    """A writer that has ended, one that has not begun, none at all."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="the pipe has no writer"):
        read_given(pipe)
    reader, writer = os.pipe()
    os.write(writer, b"all of it")
    os.close(writer)
    assert read_given(Path(f"/dev/fd/{reader}")) == b"all of it"
    os.close(reader)
    end = os.open(pipe, os.O_RDWR)  # a writer that has it open
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(read_given, pipe)
        os.write(end, b"x" * 100_000)
        os.close(end)
        assert found.result() == b"x" * 100_000


def test_what_a_person_names_is_a_file_and_no_folder_or_device(tmp_path):
    with pytest.raises(OSError, match="this is a folder"):
        read_given(tmp_path)
    with pytest.raises(OSError, match="this is a device"):
        read_given(Path("/dev/zero"))
    with pytest.raises(FileNotFoundError):
        read_given(tmp_path / "a\0b")


# --- json text --------------------------------------------------------------------------------------
# JSON read by the faster parser is what the standard library reads.


def test_numbers_are_the_same_to_the_last_bit():
    """Any bit pattern that is a finite number, seed 5, and numbers that are hard to round."""
    patterns = np.random.default_rng(5).integers(0, 2**63, 20_000, dtype=np.uint64).view(np.float64)
    hard = [5e-324, 2.2250738585072011e-308, 9007199254740993.0, -0.0, 1.7976931348623157e308, 0.1]
    numbers = [*patterns[np.isfinite(patterns)].tolist(), *hard]
    found = read_json(json.dumps(numbers).encode())
    assert np.array(found).tobytes() == np.array(numbers).tobytes()


@pytest.mark.parametrize(
    "text",
    ['"\\ud800"', '{"a": 1, "a": 2}', "123456789012345678901234567890", "-0", "1e400", '"\\u0000"', " [1]\n"],
)
def test_what_the_standard_library_takes_is_taken(text):
    assert read_json(text.encode()) == json.loads(text)


@pytest.mark.parametrize(
    "content",
    [b"NaN", b"[Infinity]", b"{", b"", b'"\xff"', b"\xef\xbb\xbf1", b"[1,]", b"'a'", b"01", b'"\t"'],
)
def test_what_is_no_json_is_refused(content):
    with pytest.raises(ValueError):  # noqa: PT011 - every kind of it is one
        read_json(content)


# --- whole ------------------------------------------------------------------------------------------
# A file is there whole or not at all; what is no file stays what it is.


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "true").write_text("before", encoding="utf-8")
    (tmp_path / "link").symlink_to(tmp_path / "true")
    write_whole(tmp_path / "link", "after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "true").read_text(encoding="utf-8") == "after"


def test_the_content_is_on_the_disk_before_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut, a file that was replaced is the old one or the new one, never an empty one."""
    synced = []
    monkeypatch.setattr(
        os, "fsync", lambda file: synced.append((os.fstat(file).st_ino, os.fstat(file).st_size))
    )
    write_whole(tmp_path / "r.json", "before")
    write_whole(tmp_path / "r.json", "afterwards")
    assert (tmp_path / "r.json").read_text(encoding="utf-8") == "afterwards"
    assert synced[-1] == ((tmp_path / "r.json").stat().st_ino, 10)


def test_what_cannot_be_written_is_named_and_leaves_no_half(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="folder"):
        write_whole(tmp_path / "folder" / "r.json", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_whole(tmp_path / "folder", "x")
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="not a valid file name") as refused:
        write_whole(tmp_path / "a\ud800", "text")
    assert "\ud800" not in str(refused.value)


def test_a_pipe_is_written_to_and_never_replaced_nor_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="the pipe has no reader"):
        write_whole(tmp_path / "pipe", "text")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_whole(tmp_path / "pipe", "text")
    assert os.read(reader, 100) == b"text"
    os.close(reader)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
