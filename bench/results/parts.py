"""Parts that several results have."""

from __future__ import annotations

from pydantic import Field

from bench.base.result_model import ResultModel


class BenchPart(ResultModel):
    """The bench file that was taken."""

    name: str = Field(description="as it calls itself")
    file: str = Field(description="where it is")
    why: str = Field(description="why that one")
    sha256: str

    @property
    def words(self) -> str:
        """Which one it is, and why that one."""
        return f"{self.name}, {self.why}"


class CorrectionPart(ResultModel):
    """The certificate of an instrument, and what was done by it."""

    instrument: str = Field(description="its name in the bench file")
    certificate: str = Field(description="number")
    laboratory: str
    date: str = Field(description="of the calibration, such as 2026-03-02")
    valid_until: str | None
    expired: bool = Field(description="whether it counted no more on the day of the readings")
    serial: str | None = Field(description="of what was calibrated")
    serial_answered: str | None = Field(
        description="that the instrument stated; empty where it states none, null where nobody knows"
    )
    correction: str = Field(description="what is added to what the instrument shows; empty for nothing")
    applied: bool = Field(description="whether the readings were corrected by it")
    why_not: str = Field(description="why not, in words; empty where they were")
