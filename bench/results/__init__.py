"""The report of a calibration: one self-contained HTML page."""

import logging

from bench.results.page import ReportContent, render_report, write_report

# where its folder for settings cannot be made it goes on without, and nobody who reads a report need know
logging.getLogger("matplotlib").setLevel(logging.ERROR)

__all__ = ["ReportContent", "render_report", "write_report"]
