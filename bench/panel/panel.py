"""What all pages of one panel share: settings, who may come in, and the runs' folder."""

from __future__ import annotations

from bench.panel.access.store import Access
from bench.panel.folder import RunsFolder
from bench.panel.following.stream import Followers
from bench.panel.settings import STATE, Settings


class Panel:
    """One panel over one folder of runs."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.runs = RunsFolder(settings.runs)
        self.followers = Followers()
        self.access = Access(settings.runs / STATE)
