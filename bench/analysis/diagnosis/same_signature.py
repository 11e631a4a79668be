"""Effects that put the very same into the readings: no size and no reading of them tells one from another."""

from __future__ import annotations

from collections.abc import Iterator

from bench.analysis.diagnosis.naming import Naming


def same_signature(naming: Naming) -> Iterator[str]:
    """Yield a sentence for each effect that was found and that others would have done the very same as."""
    for one in naming.found:
        if one.same:
            at = f" in {', '.join(one.variant.mounts)}" if one.variant.mounts else ""
            yield (
                f"{one.variant.family}{at} and {', '.join(one.same)} do the very same in all of these readings: "
                "which it is, none of them can tell at any size"
            )
