"""Results of commands: typed models, from which JSON and JSON schema are made.

    class Line(ResultModel):
        \"\"\"A straight line through points.\"\"\"

        slope: float = Field(description="V/s")
        u: Real = Field(description="standard uncertainty of the slope; null where two points tell it")
        notes: list[str] = []

    Line(slope=1.0, u=math.nan).to_dict()        # {"slope": 1.0, "u": None}

A member that a result has only sometimes has a default, and is left out of the JSON where nobody sets it.
`from_object` makes a model of the attributes of what was computed, and so the parts within it:

    Line.from_object(fitted, u=fitted.u_slope)            # fitted.slope, fitted.notes
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _listed(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


Real = Annotated[float | None, BeforeValidator(_finite)]
"""A number, or null where it is not finite: nothing shows it."""
Vector = Annotated[list[float], BeforeValidator(_listed)]
"""Numbers in a row, from a list or an array."""
Matrix = Annotated[list[list[float]], BeforeValidator(_listed)]
"""Rows of numbers, from lists or an array."""


class ResultModel(BaseModel):
    """Base of results and their parts: frozen, its members named in full, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        populate_by_name=True,
        from_attributes=True,
        defer_build=True,
    )

    @classmethod
    def from_object(cls, computed: object, **others: Any) -> Self:
        """Return the model from `others` and from the attributes of an object named like members."""
        names = [name for name in cls.model_fields if name not in others and hasattr(computed, name)]
        return cls(**{name: getattr(computed, name) for name in names}, **others)

    def to_dict(self) -> dict[str, Any]:
        """Return the members as values for JSON, without optional members that were not set."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    @classmethod
    def schema_of(cls, name: str) -> dict[str, Any]:
        """Return the JSON schema of a result (draft 2020-12), to be known as `name`."""
        schema = cls.model_json_schema(by_alias=True)
        schema["description"] = " ".join(schema["description"].split())
        return {
            "$schema": DIALECT,
            "$id": f"urn:triaxial-bench:schema:{name}",
            **schema,
            "title": f"Result of bench {name}",
        }
