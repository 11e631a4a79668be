"""YAML text to nodes: safe, fast where the parser in C is there, and no deeper than anybody writes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import yaml
from yaml.composer import Composer

MOST_DEEP: Final = 100
"""Lists and mappings in each other; a procedure of ours has about twenty."""


class TooDeep(yaml.MarkedYAMLError):
    """Lists and mappings stand too deep in each other."""


if TYPE_CHECKING or not hasattr(yaml, "CSafeLoader"):
    _Base = yaml.SafeLoader
else:

    class _Base(Composer, yaml.CSafeLoader):
        """The parser in C, whose own composer would go as deep as the text says, and take the program with it."""

        def __init__(self, stream: Any) -> None:
            yaml.CSafeLoader.__init__(self, stream)
            Composer.__init__(self)


class Loader(_Base):
    """Composes nodes, and raises `TooDeep` beyond `MOST_DEEP`; nothing is constructed of them."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._deep = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node."""
        if self._deep >= MOST_DEEP:
            problem = f"lists and keys stand more than {MOST_DEEP} deep in each other"
            raise TooDeep(problem=problem, problem_mark=self.peek_event().start_mark)  # type: ignore[no-untyped-call]
        self._deep += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._deep -= 1
