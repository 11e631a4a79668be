"""What the runs of one bench tell of it, and the learned file that its bench file takes."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bench.base.arrays import CHANNELS, Floats
from bench.base.tables import as_text
from bench.calibration.budget.meters import may_move
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.noise import METERS_DRIFT
from bench.calibration.result import CalibrationError
from bench.config.bench_file.learned import arcsec, learned_for, write_learned
from bench.config.model_file import load_model
from bench.history.learned import (
    WAVE_NAMES,
    Contrasts,
    Learned,
    MeterDifferences,
    MeterRun,
    exchanged,
    meter_differences,
)
from bench.history.learning import learn as learn_from
from bench.history.run_sums import run_fit
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.model.effects import Subsystem
from bench.results.learning import LearnResult, RecordPart, learn_result, print_learned
from bench.services.arguments import python_call
from bench.services.calibration import calibration_of
from bench.services.errors import Refused
from bench.services.requests.history import Learn
from bench.services.source import Source, data_sha256, load_sources, reading
from bench.services.traceability import voltmeter_names
from drivers.clock import utc_now

USUAL_DAYS: Final = 365
"""For so long a learned file counts where nobody says how long."""
HEAD_EFFECTS: Final = ("head_eccentricity", "head_ellipticity")
ONE_STAND: Final = (
    "the mean of an angle is taken for the stand's, the same in every installation; where installations have "
    "brackets of their own, --by-installation gives each a mean of its own"
)
OF_THE_REPEATS: Final = (
    "noise and setting error are those of repeats alone, so that what a model lacks is not charged to them"
)


@dataclass(frozen=True)
class LearningResult:
    """What was learned of a bench: `learned` holds the sizes, `sources` all runs, contradicting ones among them."""

    learned: Learned
    sources: tuple[Source, ...]
    made: datetime.date
    expires: datetime.date
    effects: tuple[AppliedEffect, ...]
    by_installation: bool

    @property
    def bench(self) -> str:
        """Which bench it is of."""
        return self.sources[0].bench.name

    @property
    def simulated(self) -> bool:
        """Whether the runs were simulated."""
        return self.sources[0].simulated

    @property
    def behind(self) -> tuple[Source, ...]:
        """The runs behind the sizes."""
        return tuple(source for source in self.sources if source.name in self.learned.runs)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader must know."""
        own = [OF_THE_REPEATS] if self.by_installation else [ONE_STAND, OF_THE_REPEATS]
        if self.simulated:
            own.append("these runs are simulated: what is learned counts for simulated runs alone")
        if self.learned.too_many_contradict:
            own.append(
                "more than a third of the runs contradict the others: this is not one bench, or it was changed in "
                "between; learn from the runs of one of its states"
            )
        return tuple(own)

    @cached_property
    def result(self) -> LearnResult:
        """The result as `bench learn --json` writes it."""
        first = self.sources[0]
        return learn_result(
            self.learned,
            bench=first.taken.part(),
            learned_for=learned_for(first.bench),
            made=self.made.isoformat(),
            expires=self.expires.isoformat(),
            simulated=self.simulated,
            records=[RecordPart(**_record(source)) for source in self.behind],
            effects=[applied.effect.name for applied in self.effects],
            notes=self.notes,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench learn --json` writes it."""
        return self.result.to_dict()

    def write(self, path: str | Path) -> None:
        """Write the learned file. Raises `Refused` where it exists or the runs are no one bench, `OSError`."""
        path = Path(path)
        if path.exists():
            raise Refused(
                f"{path}: is there already, and a learned file is not overwritten; give another --out"
            )
        if self.learned.too_many_contradict:
            raise Refused(f"{path}: not written, for more than a third of the runs contradict the others")
        write_learned(path, self._content(), self.effects)

    def _content(self) -> dict[str, Any]:
        found, first = self.learned, self.sources[0]
        known = found.known
        assert known.noise is not None  # noqa: S101 - learned so
        u = np.sqrt(np.diag(known.covariance))
        noise: dict[str, Any] = {"unit": found.unit}
        for channel, size, dof in zip(CHANNELS, known.noise.channels, known.noise.channel_dof, strict=True):
            noise[channel] = {"size": float(size), "dof": float(dof)}
        noise["setting"] = {"size": arcsec(known.noise.setting_rad), "dof": known.noise.setting_dof}
        return {
            "bench": self.bench,
            "learned_for": learned_for(first.bench),
            "made": self.made.isoformat(),
            "expires": self.expires.isoformat(),
            "simulated": self.simulated,
            "runs": [_record(source) for source in self.behind],
            "stand": {
                "means": [
                    {
                        "angle": name,
                        **({"installation": at} if at else {}),
                        "value": arcsec(value),
                        "u": arcsec(size),
                    }
                    for (name, at), value, size in zip(
                        known.keys, known.mean.tolist(), u.tolist(), strict=True
                    )
                ],
                "covariance_rad2": known.covariance.tolist(),
                "remount": {name: arcsec(size) for name, size in known.remount.items()},
            },
            "noise": noise,
            **({} if isinstance(found.meters, str) else {"meters": written_meters(found.meters)}),
            "sizes": {
                size.name: f"{size.value:.6g} {size.unit}, u {size.u:.3g}, dof {size.dof:.3g}"
                for size in found.sizes()
            },
            "contradicting": [one.sentence for one in found.contradicting],
            "not_identified": found.not_identified(),
        }

    def print_on(self, out: Console) -> None:
        """Print what contradicts first, then the sizes, then what these runs do not tell."""
        print_learned(self.learned, self.result, out)

    def __repr__(self) -> str:
        """Return what `bench learn` prints."""
        return as_text(self.print_on)


def learning_of(request: Learn, sources: Sequence[Source] | None = None) -> LearningResult:
    """Return what the runs of one bench tell of it, as `bench learn` finds it; `write` makes the learned file.

    `model` is a model file with effects of the bench, found in many runs together, which become the bench's;
    `by_installation` gives each installation mean angles of its own; the file counts until `expires` (a year, where
    nobody says). Else as in `calibrate`. `sources` are those of the request, where they are read already. Raises
    `Refused` for runs of several benches, `CalibrationError` as `bench.history.learning.learn` does.
    """
    made = utc_now().date()
    until = _until(request.expires, made)
    sources = load_sources(reading(request, *request.sources)) if sources is None else sources
    _require_one_bench(sources)
    first = sources[0]
    stand_u = first.stand_u | {name: size.u for name, size in assumed_stand(first.bench).items()}
    asked = _effects_of_model(sources)
    certified = first.bench.instruments.head.certificate is not None
    waves = not certified and not {a.effect.name for a in asked} & set(HEAD_EFFECTS)
    own = [_certified(source) for source in sources]
    fits = [run_fit(source.name, source.readings, source.model, stand_u) for source in own]
    found = learn_from(fits, stand_u, by_installation=request.by_installation, waves=waves)
    found = replace(found, meters=differences_of([source for source in own if source.name in found.runs]))
    effects = (*asked, *_circle(found))
    return LearningResult(found, tuple(sources), made, until, effects, request.by_installation)


learn = python_call(Learn, learning_of, "learn")


def _until(expires: datetime.date | str | None, made: datetime.date) -> datetime.date:
    """Return the day until which a file counts that is made today: a day, or a number of days from now."""
    if expires is None:
        return made + datetime.timedelta(days=USUAL_DAYS)
    if isinstance(expires, str):
        if expires.isascii() and expires.isdecimal() and 0 < int(expires) < 36500:
            return made + datetime.timedelta(days=int(expires))
        try:
            expires = datetime.date.fromisoformat(expires)
        except ValueError:
            raise Refused(
                f"--expires {expires}: expected a date such as 2027-01-31, or a number of days from now"
            ) from None
    if expires <= made:
        raise Refused(f"--expires {expires}: is past; give a day to come, or a number of days")
    return expires


def _certified(source: Source) -> Source:
    """Return a source as certificates have it, and with no effects but those of a model that was asked for."""
    plain = source.model if source.request.model else ForwardModel(source.bench.installation_models())
    return replace(source.as_certified(), model=plain)


def _effects_of_model(sources: Sequence[Source]) -> tuple[AppliedEffect, ...]:
    """Return the effects of the model file asked for that are of the bench. Raises `Refused` for a block's."""
    if sources[0].request.model is None:
        return ()
    # a source that the model was found in has its values without u; as found they stand in the file
    file = load_model(sources[0].request.model, sources[0].model.installations)
    effects = file.applied_effects()
    of_block = [a.effect.name for a in effects if a.effect.subsystem is Subsystem.BLOCK]
    if of_block:
        raise Refused(
            f"{sources[0].request.model}: {', '.join(of_block)} is of a block and not of the bench; learn from a "
            "model without it"
        )
    own = [a for a in effects if a.installations and any("/" in label for label in a.installations)]
    if own:
        raise Refused(
            f"{sources[0].request.model}: {own[0].effect.name} is of one mounting alone, and not of the bench"
        )
    return effects


def _circle(found: Learned) -> list[AppliedEffect]:
    """Return the head's eccentricity and ellipticity where they are shown, with u, as effects of the bench."""
    m = len(found.keys)
    u: Floats = np.sqrt(np.diag(found.covariance))
    effects = []
    for k in found.shown_waves():
        effect = CATALOGUE[HEAD_EFFECTS[k]]
        values, sizes = {}, {}
        for j in (2 * k, 2 * k + 1):
            parameter = WAVE_NAMES[j].partition(".")[2]
            values[parameter], sizes[parameter] = np.array(found.means[m + j]), np.array(u[m + j])
        effects.append(AppliedEffect(effect, values, CHANNELS, sizes))
    return effects


def _record(source: Source) -> dict[str, str]:
    head = "" if source.run is None else source.run.history.head
    own = {"name": source.name, "readings": data_sha256(source.as_read)}
    return own | ({"head": head} if head else {})


def _require_one_bench(sources: Sequence[Source]) -> None:
    first = sources[0]
    for source in sources[1:]:
        if learned_for(source.bench) != learned_for(first.bench):
            raise Refused(
                f"{source.name} is of another bench than {first.name} (stand, head, installations or meters "
                "differ); say with --bench FILE which one holds for all, or learn from the runs of one"
            )
        if source.simulated != first.simulated:
            raise Refused(
                f"{source.name} is simulated or {first.name} is, and one of both is not; do not mix them"
            )
    hashes: dict[str, str] = {}
    for source in sources:
        own = data_sha256(source.as_read)
        if own in hashes:
            raise Refused(f"{source.name}: has the same readings as {hashes[own]}; give each run once")
        hashes[own] = source.name


# --- how the voltmeters differ --------------------------------------------------------------------------

FEW_DOF: Final = 4.0
NOT_RECORDED: Final = (
    "differences between the voltmeters: no record says which voltmeter read which channel of which block; runs "
    "do, and readings files that 'bench export' wrote from them"
)
BY_ADDRESS: Final = (
    "; no record has their serial numbers, so that a voltmeter at another address passes for another (real runs "
    "keep them; in a dry run only a bench file with certificates does)"
)
NOT_VOLTS: Final = "differences between the voltmeters: the signals are in {unit}"


def differences_of(sources: Sequence[Source]) -> MeterDifferences | str:
    """Return how the voltmeters of runs of one bench differ, or why these runs do not tell it.

    The calibrations that it takes are with the stated limits of the stand, in whose rows' lengths these hardly are.
    """
    if sources[0].readings.unit != "V":
        return NOT_VOLTS.format(unit=sources[0].readings.unit)
    known = [
        (source, by_channel, day)
        for source in sources
        if source.block_name
        and (by_channel := _by_channel(source)) is not None
        and (day := _day(source)) is not None
    ]
    if not known:
        return NOT_RECORDED
    kept = exchanged([(source.block_name, meters) for source, meters, _ in known])
    runs = [run for i in kept if (run := _meter_run(*known[i])) is not None]
    found = meter_differences(runs)
    by_address = not any(source.origin.serials for source, _, _ in known if source.origin is not None)
    return found + BY_ADDRESS if isinstance(found, str) and by_address and len(kept) > 1 else found


def _by_channel(source: Source) -> tuple[str, str, str] | None:
    of = voltmeter_names(source.bench, source.taken, source.origin, source.name)
    return (of["x"], of["y"], of["z"]) if of else None


def _day(source: Source) -> float | None:
    """Return the day of a record, counted from year 1; None where it is not told."""
    try:
        return datetime.datetime.fromisoformat(source.made_at or "").timestamp() / 86400.0
    except ValueError:
        return None


def _meter_run(source: Source, meters: tuple[str, str, str], day: float) -> MeterRun | None:
    try:
        found = calibration_of(source).calibration
    except CalibrationError:
        return None
    anew = [s.covariance for s in found.sources if not s.cancels and s.of_block is None]
    forms = {c: meter for meter in source.bench.instruments.voltmeters for c in meter.channels}
    drift = [[may_move("voltmeter_gain", forms[c]), may_move("voltmeter_offset", forms[c])] for c in CHANNELS]
    return MeterRun.of(
        source.name, source.block_name, meters, day, found.block.vector,
        sum(anew, found.covariance_readings), found.block_terms, np.array(drift), float(METERS_DRIFT.days),
    )  # fmt: skip


def written_meters(found: MeterDifferences) -> dict[str, Any]:
    """Return the section of a learned file; covariances are widened for the few degrees of freedom."""
    return {
        "meters": list(found.meters),
        "group": list(found.group),
        "day": datetime.date.fromtimestamp(found.day * 86400.0).isoformat(),
        "gain": _written(found.gain),
        "offset_v": _written(found.zero),
        "runs": list(found.runs),
    }


def _written(of: Contrasts) -> dict[str, Any]:
    nu = max(float(np.min(of.freedom)), FEW_DOF)
    covariance: Floats = of.covariance * (nu / (nu - 2.0) if np.isfinite(nu) else 1.0)
    return {"values": of.values.tolist(), "covariance": ((covariance + covariance.T) / 2).tolist()}
