"""What is found out about one body of readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import Data, Whitened
from bench.analysis.diagnosis.form.describe import FreeForm
from bench.analysis.diagnosis.gap import Gap
from bench.analysis.diagnosis.known_together import KnownTogether
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.analysis.diagnosis.noise_findings import NoiseFinding
from bench.analysis.diagnosis.noise_kinds import NoiseKind
from bench.analysis.diagnosis.posterior import NoiseSize, Posterior
from bench.analysis.diagnosis.registration import Registration
from bench.analysis.diagnosis.visibility import Smallest
from bench.analysis.diagnosis.weighing import WeighedDown
from bench.analysis.diagnosis.where import Place
from bench.analysis.mistakes.search import Mistake, MistakeSearch
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE, AppliedEffect

Verdict = Literal["agrees", "mistake", "named", "confounded", "unknown"]

UNNAMED_WORDS: Mapping[str, str] = {
    "free_by_angle": "something that depends on the angle of the head, the same in every pass",
    "free_head_angle": "an error of the head's angle, the same in every pass and installation",
    "free_by_pass": "something that differs from pass to pass",
    "slow_in_time": "something that changes slowly with time",
    "step": "a step of the signal",
    "single_reading": "a single reading that stands apart",
    "single_setting": "the angle of a single setting",
    "zeros_by_run": "the zeros change from run to run; the readings do not say why",
    "scale_by_run": "the scale factors change from run to run; the readings do not say why",
    "unnamed_form": "something without a name, of another form",
    "lack_of_fit": (
        "the readings differ from the model by more than their repeats, in no pattern that was looked for"
    ),
}


@dataclass(frozen=True)
class EffectValue:
    """A parameter as estimated, in the catalogue's unit. Of a shape `u` is None: it was tried, not estimated.

    `channel` is empty where it is of all, `installations` where the effect has one set of values.
    """

    parameter: str
    channel: str
    installations: str
    value: float
    u: float | None
    unit: str


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found, with its parameters as estimated.

    `aliases` are the other periods a turn of the head that would look the same at the angles measured.
    `applied` is empty for what has no name, else one entry for each set of mountings with values of its own.
    `together` are sums or differences of values that the readings tell where they hardly tell the values.
    `p` is for this effect alone, `p_all_looks` counts everything that was looked at; `rho` is its size in
    units of noise, None for a lack of fit, which was not looked for.
    """

    name: str
    channels: tuple[str, ...]
    installations: tuple[str, ...]
    cannot_tell_from: tuple[str, ...]
    plainer_than: tuple[str, ...]
    parameters: tuple[EffectValue, ...]
    p: float
    p_all_looks: float
    rho: float | None
    words: str
    applied: tuple[AppliedEffect, ...] = ()
    together: tuple[KnownTogether, ...] = ()
    aliases: tuple[int, ...] = ()

    @property
    def in_catalogue(self) -> bool:
        """Whether it has a name."""
        return self.name in CATALOGUE

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "name": self.name,
            "channels": list(self.channels),
            "installations": list(self.installations),
            "cannot_tell_from": list(self.cannot_tell_from),
            "plainer_than": list(self.plainer_than),
            "parameters": nested(self.parameters),
            "together": [asdict(one) for one in self.together],
            "shape_held": any(one.u is None for one in self.parameters),
            "p": self.p,
            "p_all_looks": self.p_all_looks,
            "rho": self.rho,
            "aliases": list(self.aliases),
            "words": self.words,
        }


def nested(values: Sequence[EffectValue]) -> dict[str, Any]:
    """Return values by installations, parameter and channel, each level where there is one."""
    tree: dict[str, Any] = {}
    for one in values:
        levels = [key for key in (one.installations, one.parameter, one.channel) if key]
        branch = tree
        for key in levels[:-1]:
            branch = branch.setdefault(key, {})
        u = {} if one.u is None else {"u": one.u}
        branch[levels[-1]] = {"value": one.value, **u, "unit": one.unit}
    return tree


@dataclass(frozen=True)
class Diagnosis:
    """All that was found out about one body of readings.

    `of_copy` is the verdict on the copy in which mistakes are put right, where there are any, and the same as
    `verdict` where not. `hidden` are effects that the readings could never show, with their parts where it is true
    of some; `absent` effects of what the bench has not, with the reason; `unseen_per_turn` how often a turn an
    error of the head would have to repeat to show nowhere at the angles measured; `detectable` the sizes, in
    plausible sizes, that are found in half of all runs, `smallest` of effects with several in whatever
    direction. `linear`, `candidates`, `naming`, `fitted` and `noise` are what plots and report are drawn from;
    `whitened` and `data` are those in which it was found;
    `in_part` what the effects may have of other shapes, which is in the coefficients' u, `left_open` what the
    readings left of it, for a model file; `findings` where noise is
    larger than stated, `noise_kinds` in what it is no normal noise of one size; `weighed` what
    readings were weighed down by.
    """

    verdict: Verdict
    of_copy: Verdict
    where: tuple[Place, ...]
    mistakes: MistakeSearch
    effects: tuple[NamedEffect, ...]
    hidden: Mapping[str, tuple[str, ...]]
    absent: Mapping[str, str]
    unseen_per_turn: tuple[int, ...]
    detectable: Mapping[str, float]
    smallest: Mapping[str, tuple[Smallest, ...]]
    gap: Gap
    registered: Registration
    linear: LinearSystem
    candidates: Candidates
    naming: Naming
    fitted: Posterior
    in_part: tuple[AppliedEffect, ...]
    left_open: tuple[AppliedEffect, ...]
    noise: NoiseSize
    p_left: float
    whitened: Whitened
    data: Data
    form: FreeForm | None = None
    findings: tuple[NoiseFinding, ...] = ()
    noise_kinds: tuple[NoiseKind, ...] = ()
    notes: tuple[str, ...] = ()
    weighed: WeighedDown | None = None

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The named effects with their values, and the terms of what has no name, to be added to the model."""
        of_form = self.form.applied if self.form is not None else ()
        return (*(a for e in self.effects for a in e.applied), *of_form)

    @property
    def noise_by_channel(self) -> Floats:
        """Noise of a reading of x, y, z, unit of the signal."""
        return self.noise.reading * self.linear.by_channel

    def to_dict(self) -> dict[str, Any]:
        """Return the promised result; who proposes a measurement or writes a model file puts them in."""
        return {
            "verdict": self.verdict,
            "where": [asdict(place) for place in self.where],
            "effects": [
                *(mistake_to_dict(mistake) for mistake in self.mistakes.mistakes),
                *(effect.to_dict() for effect in self.effects),
            ],
            "next_measurement": None,
            "hidden": list(self.hidden),
            "hidden_parts": {name: list(parts) for name, parts in self.hidden.items() if parts},
            "absent": dict(self.absent),
            "unseen_per_turn": list(self.unseen_per_turn),
            "verification_orientation": None
            if self.linear.orientation is None
            else self.linear.orientation.to_dict(),
            "gap": self.gap.to_dict(),
            "model": None,
            "noise": {
                "reading": self.noise.reading,
                "setting_arcsec": self.noise.setting_arcsec,
                "dof": self.noise.freedom,
                "channels": dict(zip(CHANNELS, self.noise_by_channel.tolist(), strict=True)),
                "kinds": [asdict(kind) for kind in self.noise_kinds],
                "findings": [finding.to_dict() for finding in self.findings],
            },
            "p_left": self.p_left,
            "form": None if self.form is None else self.form.to_dict(),
            "detectable": dict(self.detectable),
            "registered": asdict(self.registered),
            "notes": list(self.notes),
        }


def mistake_to_dict(mistake: Mistake) -> dict[str, Any]:
    """Return the promised form of a mistake."""
    return {
        "name": mistake.name,
        "channels": list(mistake.channels),
        "cannot_tell_from": list(mistake.cannot_tell_from),
        "installations": list(mistake.installations),
        "parameters": {
            "pass": mistake.pass_number,
            "point": mistake.point,
            "misfit_before": mistake.evidence.before,
            "misfit_after": mistake.evidence.after,
        },
        "p": mistake.p,
        "p_all_looks": mistake.p,
        "words": mistake.words,
    }
