"""Readings that errors act on: those of a plan, or those that were taken."""

from __future__ import annotations

from typing import Protocol

from bench.base.arrays import Floats, Ints
from bench.model import Block, Conditions


class Seen(Protocol):
    """What an error needs to know of n readings."""

    @property
    def signal(self) -> Floats:
        """The signals, V, shape (n, 3)."""

    @property
    def force(self) -> Floats:
        """The specific forces on the block, g, shape (n, 3)."""

    @property
    def setting_slope(self) -> Floats:
        """du/dphi, V/rad, shape (n, 3)."""

    @property
    def orientation(self) -> Ints:
        """A number for each reading, shape (n,): the same where the specific force is the same."""

    @property
    def conditions(self) -> Conditions:
        """Where, when and how warm each reading is."""

    @property
    def block(self) -> Block:
        """The block that they are of."""

    @property
    def meters(self) -> tuple[int, int, int]:
        """The number of the voltmeter of x, y and z."""
