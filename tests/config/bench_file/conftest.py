"""The mistakes of a bench file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench


@pytest.fixture
def mistakes(tmp_path: Path) -> Callable[[str], list[str]]:
    """Return the mistakes of a text as "line place: text"."""

    def of(text: str) -> list[str]:
        path = tmp_path / "bench.yaml"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(FileMistakes) as error:
            load_bench(path)
        assert str(error.value).splitlines()[0].startswith(str(path))
        return [f"{m.line} {m.place}: {m.text}" for m in error.value.mistakes]

    return of
