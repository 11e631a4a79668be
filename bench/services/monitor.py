"""Stability monitors: a few positions of one installation, charted over days."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.base.files import to_text
from bench.history.control_chart import CheckRun, ControlChart
from bench.history.monitor import monitor_chart, monitor_run
from bench.model.geometry import STAND_ANGLES, Block
from bench.results.monitor import MonitorResult, monitor_figures, monitor_result
from bench.services.arguments import python_call
from bench.services.coefficients import date_of
from bench.services.errors import Refused
from bench.services.requests.history import Monitor
from bench.services.source import Source, load_sources, reading


@dataclass(frozen=True)
class Monitored:
    """The chart of a series of monitors, and the sources behind it."""

    chart: ControlChart
    sources: tuple[Source, ...]

    @property
    def result(self) -> MonitorResult:
        """The result for JSON."""
        return monitor_result(self.chart)

    def files(self, out: Path) -> Iterator[tuple[str, Path, str]]:
        """Yield description, path and text of each file in `out`."""
        yield "result", out / "monitor.json", to_text(self.result.to_dict())
        for name, figure in monitor_figures(self.chart).items():
            yield "chart", out / f"monitor-{name}.svg", figure


def monitored(request: Monitor) -> Monitored:
    """Return the control chart of runs of `monitor-2` or `monitor-4`; the first `baseline` set its limits.

    Raises `Refused` for a source without date, `CalibrationError` if runs are too few or unlike.
    """
    sources = tuple(load_sources(reading(request, *request.sources)))
    return Monitored(monitor_chart([_run(source) for source in sources], request.baseline), sources)


def _run(source: Source) -> CheckRun:
    when = date_of(source.made_at, source.name)
    if when is None:
        raise Refused(f"{source.name}: has no date; use runs, or a file that 'bench export' wrote")
    conditions = source.readings.conditions()
    stand = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
    force = source.model.specific_force(conditions, stand, Block(np.eye(3), np.zeros(3)))
    return monitor_run(source.name, when, source.readings.signal, force)


monitor = python_call(Monitor, monitored)
