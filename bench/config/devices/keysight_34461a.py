"""Keysight Truevolt 34460A, 34461A, 34465A, 34470A."""

from __future__ import annotations

from typing import ClassVar, Literal

from bench.config.devices.device import Device
from bench.config.devices.sections import OneChannelForm
from drivers.facts import keysight_34461a as truevolt


class Keysight34461ASection(OneChannelForm):
    """A 34460A, 34461A, 34465A or 34470A; `interface` "lan" stands for USB, too."""

    facts: ClassVar = truevolt

    driver: Literal["keysight-34461a"]
    interface: Literal["lan", "gpib"] = "lan"


DEVICE = Device(
    "keysight-34461a",
    Keysight34461ASection,
    driver="drivers.instruments.keysight_34461a:Keysight34461A",
    simulation="sim.keysight_34461a:Keysight34461A",
    example={"channels": ["x"], "resource": "TCPIP0::192.0.2.22::5025::SOCKET"},
    simulated=("noise", "accuracy"),
)
