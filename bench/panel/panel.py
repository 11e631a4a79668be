"""What all pages of one panel share: settings, who may come in, and the runs' folder."""

from __future__ import annotations

from collections import Counter

from bench.panel.access import Access
from bench.panel.folder import Certificates, RunsFolder
from bench.panel.following.stream import Followers
from bench.panel.holding import read_holding
from bench.panel.launching import Started, Wishes
from bench.panel.settings import STATE, Settings
from bench.panel.table import RunsTable


class Panel:
    """One panel over one folder of runs."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.runs = RunsFolder(settings.runs)
        self.table = RunsTable(self.runs)
        self.wishes = Wishes(settings.runs / STATE / "wishes")
        self.diagnosing: dict[str, Started] = {}
        self.followers = Followers(lambda folder: {"control": read_holding(folder).to_json()})
        self.certificates = Certificates(settings.laboratory)
        self.streams: Counter[str] = Counter()
        self.access = Access(settings.runs / STATE)
