"""The report of a calibration: one self-contained HTML page."""

from bench.report.content import ReportContent
from bench.report.page import render_report, write_report

__all__ = ["ReportContent", "render_report", "write_report"]
