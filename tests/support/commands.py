"""Checks of a command's exit status and output."""

from pathlib import Path

Answer = tuple[int | str | None, str, str]
"""Exit status, standard output, standard error."""


def refused(answer: Answer, *words: str, lines: int = 1) -> str:
    """Assert status 2 and standard error with these `words` in `lines` lines; return standard error.

    Lines that begin with "note:" do not count.
    """
    status, _, err = answer
    assert status == 2, err
    assert "Traceback" not in err
    assert len([line for line in err.splitlines() if not line.startswith("note:")]) == lines, err
    assert [one for one in words if one not in err] == [], err
    return err


def printed(answer: Answer, *words: str, status: int = 0) -> str:
    """Assert this status, and these `words` in standard output; return standard output."""
    found, out, err = answer
    assert found == status, err
    assert [one for one in words if one not in out] == [], out
    return out


def without_figures(folder: Path) -> None:
    """Make programs with `folder` on `PYTHONPATH` leave figures empty, as drawing takes seconds."""
    (folder / "sitecustomize.py").write_text(
        "from bench.results import plots\n"
        "plots._written = lambda name, inches, draw: '<svg viewBox=\"0 0 1 1\"></svg>'\n",
        encoding="utf-8",
    )
