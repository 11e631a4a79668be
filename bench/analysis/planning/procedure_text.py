"""A procedure file for chosen test points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from bench.analysis.planning.points import passes
from bench.analysis.planning.settings import Cost
from bench.base.arrays import HOUR
from bench.base.words import APPROACH, exact_degrees, exact_duration
from bench.model import Mounting
from bench.procedure.plan import Plan, Read
from bench.readings.table import VERIFICATION

VERIFICATION_DEG: Final = (45, 135, 225, 315)
SAMPLES: Final = 10
NPLC: Final = 10.0
SETTLE_S: Final = 10.0
"""A reading as the shipped procedures take it."""


@dataclass(frozen=True)
class Times:
    """What the operator and the bench take, s: a turn of the head, a mounting, settling after it, warm-up."""

    turn_s: float = 120.0
    mount_s: float = 1200.0
    soak_s: float = 600.0
    warm_up_s: float = HOUR

    def cost(self, line_hz: float, *, verified: bool) -> Cost:
        """Return what settings and mountings cost; `verified` adds the verification points at the end."""
        read = Read("", "", 1, 1, 1, None, None, SAMPLES, NPLC)
        setting_s = self.turn_s + SETTLE_S + Plan("", (), "").step_duration_s(read, line_hz)
        mount_s = self.mount_s + self.soak_s
        check_s = mount_s + len(VERIFICATION_DEG) * setting_s if verified else 0.0
        return Cost(setting_s, mount_s, self.warm_up_s + check_s)


def procedure_text(
    name: str, remarks: str, visits: Mapping[Mounting, Mapping[float, int]], times: Times, *, verified: bool
) -> str:
    """Return the text of a procedure file: `remarks` as comments, warm-up, each mounting, verification points.

    `visits` says for each mounting how often each angle (rad) is visited.
    """
    lines = [f"# {line}".rstrip() for line in remarks.splitlines()]
    lines += [
        f"procedure: {name}",
        "title: Test points chosen by bench plan-points",
        "",
        f"reading: {{samples: {SAMPLES}, nplc: {NPLC:g}, settle: {exact_duration(SETTLE_S)}}}",
        "",
        "# For the estimate of the time only.",
        f"operator_time: {{turn: {exact_duration(times.turn_s)}, mount: {exact_duration(times.mount_s)}}}",
        "",
        "steps:",
    ]
    if times.warm_up_s:
        lines.append(
            f"  - wait: {{for: {exact_duration(times.warm_up_s)}, reason: warm-up of block and voltmeters}}"
        )
    for mount, angles in visits.items():
        lines += ["", *_installation(mount.installation, times)]
        for group in passes(angles):
            words = ", ".join(APPROACH[direction] for direction in group.directions)
            angles_text = ", ".join(exact_degrees(angle) for angle in group.angle_rad)
            first = f", first_point: {group.first_point}" if group.first_point > 1 else ""
            lines += [
                "        - repeat:",
                f"            directions: [{words}]",
                "            steps:",
                f"              - turn: {{angles: [{angles_text}]{first}}}",
            ]
    if verified:
        angles_text = ", ".join(f"{angle} deg" for angle in VERIFICATION_DEG)
        lines += ["", *_installation(VERIFICATION, times), f"        - turn: {{angles: [{angles_text}]}}"]
    return "\n".join(lines) + "\n"


def _installation(label: str, times: Times) -> list[str]:
    lines = ["  - installation:", f"      label: {label}", "      steps:"]
    if times.soak_s:
        lines.append(
            f"        - wait: {{for: {exact_duration(times.soak_s)}, reason: the block settles after mounting}}"
        )
    return lines
