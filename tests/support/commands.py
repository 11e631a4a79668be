"""What commands answer, held against what they promise."""

from pathlib import Path

Answer = tuple[int | str | None, str, str]
"""Exit status, standard output, standard error."""


def refused(answer: Answer, *words: str, lines: int = 1) -> str:
    """Fail unless a command ended with status 2 and one line, or so many, with these words; return standard error.

    Notes do not count as lines.
    """
    status, _, err = answer
    assert status == 2, err
    assert "Traceback" not in err
    assert len([line for line in err.splitlines() if not line.startswith("note:")]) == lines, err
    assert [one for one in words if one not in err] == [], err
    return err


def printed(answer: Answer, *words: str, status: int = 0) -> str:
    """Fail unless a command ended with this status and printed these words; return all that it printed."""
    found, out, err = answer
    assert found == status, err
    assert [one for one in words if one not in out] == [], out
    return out


def without_figures(folder: Path) -> None:
    """Let programs with this folder on `PYTHONPATH` leave figures empty, as tests do: drawing takes seconds."""
    (folder / "sitecustomize.py").write_text(
        "from bench.results import plots\n"
        "plots._written = lambda name, inches, draw: '<svg viewBox=\"0 0 1 1\"></svg>'\n",
        encoding="utf-8",
    )
