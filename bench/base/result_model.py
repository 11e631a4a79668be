"""Results of commands: typed models, which give their JSON and (`docs/generators/schemas.py`) its schema.

    class Line(ResultModel):
        \"\"\"A straight line through points.\"\"\"

        slope: float = Field(description="V/s")
        u: Real = Field(description="standard uncertainty of the slope; null for two points, without residual")
        notes: list[str] = []

    Line(slope=1.0, u=math.nan).to_dict()        # {"slope": 1.0, "u": None}

A long description may stand as a text below the member instead; the schema shows it in the same way. An
optional member has a default, and is left out of the JSON unless set. `from_object` makes a model from the
attributes of a computed object, nested models included:

    Line.from_object(fitted, u=fitted.u_slope)            # fitted.slope, fitted.notes
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _listed(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


Real = Annotated[float | None, BeforeValidator(_finite)]
"""A number, or null if it is not finite."""
Vector = Annotated[list[float], BeforeValidator(_listed)]
"""A list of numbers, given as a list or an array."""
Matrix = Annotated[list[list[float]], BeforeValidator(_listed)]
"""A list of rows of numbers, given as lists or an array."""


class ResultModel(BaseModel):
    """Base class of results and their parts, which are frozen and reject unknown members, NaN and infinity."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        populate_by_name=True,
        from_attributes=True,
        defer_build=True,
    )

    @classmethod
    def from_object(cls, *computed: object, **others: Any) -> Self:
        """Return a model whose members come from `others` and from the attributes of the objects `computed`.

        A member in `others` takes precedence. If several objects have an attribute, the first object supplies it.
        """
        found = {
            name: getattr(one, name)
            for one in reversed(computed)
            for name in cls.model_fields
            if name not in others and hasattr(one, name)
        }
        return cls(**found, **others)

    def to_dict(self) -> dict[str, Any]:
        """Return the members as a JSON object, without optional members that were not set."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)
