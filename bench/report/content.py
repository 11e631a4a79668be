"""What a report is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bench.analysis.calibration import Calibration, Verification


@dataclass(frozen=True)
class ReportContent:
    """Everything that the page says; it adds nothing of its own, no date and no version.

    `verification` is None where no verification point was measured. `compared` is the same data by another
    estimator, such as the closed form beside generalised least squares; one by the same estimator is left
    out. `provenance` is shown as it comes, name and text (run, procedure, bench file and hashes, operator,
    unit under test, versions, dates). `notes` and `skipped` are sentences on the readings. `simulated` puts
    a banner over the page.
    """

    title: str
    calibration: Calibration
    verification: Verification | None = None
    compared: Calibration | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    simulated: bool = False

    @property
    def other(self) -> Calibration | None:
        """The calibration to compare with, where there is one by another estimator."""
        if self.compared is None or self.compared.estimator == self.calibration.estimator:
            return None
        return self.compared
