"""Checks of the voltmeters: settings, duration of a reading, simultaneous start, and noise with shorted inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final, Protocol, runtime_checkable

import numpy as np

from bench.base.languages import message
from bench.base.numbers import scale_for
from bench.config.devices.sections import VoltmeterForm
from bench.run.commission.session import CommissioningSession, Figure, Finding, State
from bench.run.driver_checks import checked_samples
from bench.run.workbench import QUICK_NPLC
from drivers.interfaces import Channel, Voltmeter, VoltmeterSettings

SETTINGS: Final = message("settings", "heading")
TIME: Final = message("time of a reading")
TOGETHER: Final = message("together", "heading")
NOISE: Final = message("noise, inputs shorted")

SHORT_INPUTS: Final = message(
    "Take the signals off the voltmeters and short their inputs, HI to LO, with copper and no longer than "
    "needed"
)
TIMED_SAMPLES: Final = 10
NOISE_SAMPLES: Final = 30
SLOW_NPLC: Final = 10.0
"""Longest integration time used in the checks, in line periods; calibrations seldom use a longer one."""
TIME_MARGIN: Final = 1.05
TIME_MARGIN_S: Final = 0.25
"""A reading may last its expected time times `TIME_MARGIN`, plus this time, s: commands on the wire."""
START_PART: Final = 0.1
"""Greatest difference between the meters' start times, as a fraction of a reading's duration."""
SIGNIFICANCE: Final = 1e-3
"""Probability that chance alone puts the scatter of a good channel above its limit."""


@runtime_checkable
class _Timed(Protocol):
    """A voltmeter whose driver states the duration of a reading."""

    def reading_time_s(self, settings: VoltmeterSettings, character_time_s: float = 0.0) -> float:
        """Return the time, s, from the start of a reading until the last character of its samples arrives."""
        ...


# --- settings ---------------------------------------------------------------------------------------


def quick(evening: CommissioningSession, meter: Voltmeter) -> VoltmeterSettings:
    """Return settings for a short reading, used to query a meter."""
    return _settings(evening, meter, QUICK_NPLC, evening.file.least_samples)


def slow(evening: CommissioningSession, meter: Voltmeter, samples: int) -> VoltmeterSettings:
    """Return settings for a precise reading with `samples` samples."""
    return _settings(evening, meter, SLOW_NPLC, samples)


def _settings(
    evening: CommissioningSession, meter: Voltmeter, nplc: float, samples: int
) -> VoltmeterSettings:
    """Return settings with the longest supported integration time up to `nplc` line periods.

    The choice is among the times that all meters support or, if there are none, among those of `meter`. The
    number of samples is clipped to the limits of the bench file.
    """
    has = evening.file.nplc_supported or _form(evening, meter).kind.limits.nplc
    near = [one for one in has if one <= nplc] or [min(has)]
    few, many = evening.file.least_samples, evening.file.most_samples
    return VoltmeterSettings(evening.file.voltmeter_range_v, max(near), min(max(samples, few), many))


def check_settings(evening: CommissioningSession) -> None:
    """Set up each meter twice, with different settings; each time, the driver reads the settings back."""
    for meter in evening.instruments.voltmeters:
        evening.carry_out(SETTINGS, meter, partial(_set_twice, evening, meter))


def _set_twice(evening: CommissioningSession, meter: Voltmeter) -> Finding:
    ways = (slow(evening, meter, TIMED_SAMPLES), quick(evening, meter))
    begun_s = evening.time_s()
    for way in ways:
        meter.configure(way)
    took = Figure("set up in", (evening.time_s() - begun_s) / len(ways), "s")
    speeds = " and ".join(f"{way.nplc:g} NPLC" for way in ways)
    return Finding(
        SETTINGS, meter.name, State.WORKS, f"{ways[0].range_v:g} V with {speeds} came back", (took,)
    )


# --- time -------------------------------------------------------------------------------------------


def check_time(evening: CommissioningSession) -> None:
    """Take a reading with each meter alone, and compare its duration with the driver's expectation."""
    for meter in evening.instruments.voltmeters:
        evening.carry_out(TIME, meter, partial(_timed, evening, meter), by_answers=False)


def _timed(evening: CommissioningSession, meter: Voltmeter) -> Finding:
    settings = slow(evening, meter, TIMED_SAMPLES)
    meter.configure(settings)
    samples, took_s = reading(evening, meter)
    first_samples = ", ".join(f"{channel} {values[0]:+.6f} V" for channel, values in samples.items())
    said = f"{settings.samples} samples at {settings.nplc:g} NPLC ({first_samples})"
    return _judged_by_time(evening, meter, settings, Finding(TIME, meter.name, State.WORKS, said), took_s)


def reading(
    evening: CommissioningSession, meter: Voltmeter
) -> tuple[Mapping[Channel, tuple[float, ...]], float]:
    """Return the samples of one reading of a meter, V, and its duration, s."""
    begun_s = evening.time_s()
    meter.start()
    samples = meter.fetch()
    return samples, evening.time_s() - begun_s


def _judged_by_time(
    evening: CommissioningSession,
    meter: Voltmeter,
    settings: VoltmeterSettings,
    found: Finding,
    took_s: float,
) -> Finding:
    """Return the finding with the duration `took_s` added; if this is too long, the state is SLOWER."""
    expected_s = expected_time_s(evening, meter, settings)
    held = "the driver does not say" if expected_s is None else f"the driver expects {expected_s:.3g} s"
    figures = (*found.figures, Figure("reading took", took_s, "s", held))
    if expected_s is None or took_s <= TIME_MARGIN * expected_s + TIME_MARGIN_S:
        return Finding(found.check, found.instrument, found.state, found.said, figures)
    said = f"{found.said}, in {took_s:.3g} s where the driver expects {expected_s:.3g} s"
    remedy = (
        "switch off display, filter and trigger delay, check the adapter, and compare the line frequency "
        "in the bench file with the mains"
    )
    return Finding(found.check, found.instrument, State.SLOWER, said, figures, remedy)


def expected_time_s(
    evening: CommissioningSession, meter: Voltmeter, settings: VoltmeterSettings
) -> float | None:
    """Return the expected duration of a reading, s, as the driver states it; None if it states none."""
    if not isinstance(meter, _Timed):
        return None
    section = _form(evening, meter)
    serial = section.port().serial if section.interface == "rs232" else None
    return meter.reading_time_s(settings, _character_s(serial))


def _character_s(serial: Mapping[str, object] | None) -> float:
    """Return the time, s, of a character with its start bit on a serial line; 0 without serial settings."""
    if serial is None:
        return 0.0
    bits = 1 + int(str(serial["data_bits"])) + (serial["parity"] != "none") + int(str(serial["stop_bits"]))
    return bits / float(str(serial["baud_rate"]))


# --- together ---------------------------------------------------------------------------------------


def check_together(evening: CommissioningSession) -> None:
    """Start all meters as a run does; measure the spread of their starts and of the arrival of their samples."""
    meters = [meter for meter in evening.instruments.voltmeters if evening.present(meter)]
    if not meters:
        return
    first, *others = meters
    evening.carry_out(
        TOGETHER, first, partial(_started_together, evening, meters), also=others, by_answers=False
    )


def _started_together(evening: CommissioningSession, meters: Sequence[Voltmeter]) -> Finding:
    settings = slow(evening, meters[0], TIMED_SAMPLES)
    for meter in meters:
        meter.configure(settings)
    begun_s = evening.time_s()
    starts_s, ends_s = _one_set(evening, meters)
    took_s = evening.time_s() - begun_s
    expected_s = max((expected_time_s(evening, meter, settings) or 0.0 for meter in meters), default=0.0)
    most_s = START_PART * (expected_s or took_s)
    names = " ".join(meter.name for meter in meters)
    figures = (
        Figure("starts within", starts_s, "s", message(f"at most {most_s:.2g} s, a tenth of a reading")),
        Figure("readings came within", ends_s, "s"),
        Figure("the set took", took_s, "s", message(f"one reading {expected_s:.3g} s") if expected_s else ""),
    )
    if len(meters) == 1:
        channels = " ".join(meters[0].channels)
        said = f"one meter reads {channels}" + (" one after the other" if len(meters[0].channels) > 1 else "")
        return Finding(TOGETHER, meters[0].name, State.WORKS, said, figures[2:])
    late_s = TIME_MARGIN * expected_s + TIME_MARGIN_S * len(meters)
    if starts_s > most_s or (expected_s and took_s > late_s):
        return Finding(
            TOGETHER, meters[-1].name, State.SLOWER,
            f"the meters ({names}) do not sample together: their starts spread over {starts_s:.2g} s, "
            f"and the set took {took_s:.3g} s", figures,
            "find the slow wire in the times of the other checks, or settle longer before each reading",
        )  # fmt: skip
    return Finding(TOGETHER, meters[0].name, State.WORKS, f"{names} sample at the same time", figures)


def _one_set(evening: CommissioningSession, meters: Sequence[Voltmeter]) -> tuple[float, float]:
    """Take a reading; return the spread of the meters' start times, s, and of the arrival of their samples, s."""
    starts, ends = [], []
    for meter in meters:
        meter.start()
        starts.append(evening.time_s())
    for meter in meters:
        meter.fetch()
        ends.append(evening.time_s())
    return max(starts) - min(starts), max(ends) - min(ends)


# --- noise ------------------------------------------------------------------------------------------


def check_noise(evening: CommissioningSession) -> None:
    """Ask for shorted inputs; compare mean and scatter of each channel with the data sheet's limits."""
    evening.confirm(
        f"{SHORT_INPUTS}; wait two minutes. Are all inputs shorted?",
        action={"do": "select_input", "source": "short"},
    )
    measure_noise(evening)
    evening.confirm(
        "Take the shorts off and connect the signals again. Done?",
        action={"do": "select_input", "source": "signal"},
    )


class SharedReading:
    """A reading of `samples` samples of each channel; all voltmeters start together."""

    def __init__(self, evening: CommissioningSession, samples: int) -> None:
        self._evening = evening
        self._samples = samples
        self._begun: dict[str, tuple[VoltmeterSettings, float] | Exception] = {}

    def checks(self, check: str, look: Callable[[Voltmeter, SharedReading], Finding]) -> None:
        """Carry out the check `check` of each voltmeter; `look` judges the voltmeter's part of this reading."""
        also: Sequence[Voltmeter] = self._opened
        for meter in self._evening.instruments.voltmeters:
            others = [one for one in also if one is not meter]
            self._evening.carry_out(check, meter, partial(look, meter, self), also=others, by_answers=False)
            also = ()

    def of(self, meter: Voltmeter) -> tuple[VoltmeterSettings, Mapping[Channel, tuple[float, ...]], float]:
        """Return the settings of a meter, its samples, V, and the duration of its reading, s.

        The first call starts all meters that are open. Raises the errors of the meter.
        """
        if meter.name not in self._begun:
            self._start([meter, *(one for one in self._opened if one is not meter)])
        begun = self._begun[meter.name]
        if isinstance(begun, Exception):
            raise begun
        settings, begun_s = begun
        asked_s = self._evening.time_s()
        samples = checked_samples(meter, meter.fetch(), settings)
        # Samples that were ready while another meter was fetched did not take longer than expected.
        expected_s = expected_time_s(self._evening, meter, settings) or math.inf
        return settings, samples, min(asked_s - begun_s, expected_s) + self._evening.time_s() - asked_s

    @property
    def _opened(self) -> list[Voltmeter]:
        evening = self._evening
        return [
            meter
            for meter in evening.instruments.voltmeters
            if meter.name in evening.identities and meter.name not in self._begun and evening.present(meter)
        ]

    def _start(self, meters: Sequence[Voltmeter]) -> None:
        ready: list[tuple[Voltmeter, VoltmeterSettings]] = []
        for meter in meters:
            settings = slow(self._evening, meter, self._samples)
            try:
                meter.configure(settings)
                ready.append((meter, settings))
            except Exception as error:  # the check of this meter reports it
                self._begun[meter.name] = error
        for meter, settings in ready:
            self._begun[meter.name] = settings, self._evening.time_s()
            try:
                meter.start()
            except Exception as error:
                self._begun[meter.name] = error


def measure_noise(evening: CommissioningSession) -> None:
    """Compare mean and scatter of each channel, whose input is shorted, with the data sheet's limits."""
    SharedReading(evening, NOISE_SAMPLES).checks(NOISE, partial(_noise, evening))


def _noise(evening: CommissioningSession, meter: Voltmeter, shared: SharedReading) -> Finding:
    settings, samples, took_s = shared.of(meter)
    limit_v = zero_limit_v(evening, meter)
    stated_v = evening.file.stand_distributions()["voltmeter_error"].limit
    sigma_v = scatter_limit_v(evening, meter, settings.nplc)
    figures: list[Figure] = []
    wrong: list[str] = []
    for channel, values in samples.items():
        shown, trouble = _of_channel(channel, values, limit_v, stated_v, sigma_v)
        figures += shown
        wrong += trouble
    n = settings.samples
    said = (
        f"mean and scatter of {n} samples at {settings.nplc:g} NPLC are within the limits of data sheet or "
        "bench file"
    )
    if not wrong:
        found = Finding(NOISE, meter.name, State.WORKS, said, tuple(figures))
        return _judged_by_time(evening, meter, settings, found, took_s)
    return Finding(
        NOISE, meter.name, State.OTHER, ", ".join(wrong), tuple(figures),
        "short the input at the meter's own terminals and warm it up for an hour; if the fault remains, "
        "have the meter adjusted",
    )  # fmt: skip


def _of_channel(
    channel: Channel, values: Sequence[float], limit_v: float, stated_v: float, sigma_v: float
) -> tuple[list[Figure], list[str]]:
    """Return mean and standard deviation of a channel as figures, and a phrase for each exceeded limit.

    The mean may differ from zero by the larger of `limit_v` and `stated_v`, plus three standard deviations of
    the mean. The standard deviation s of n samples is too large if (n - 1) s² / `sigma_v`² exceeds the
    chi-square quantile with n - 1 degrees of freedom for the probability `SIGNIFICANCE`.
    """
    n = len(values)
    mean_v, s_v = float(np.mean(values)), float(np.std(values, ddof=1)) if n > 1 else 0.0
    most_mean_v = max(limit_v, stated_v) + 3.0 * s_v / math.sqrt(n)
    most_s_v = largest_scatter_v(sigma_v, n)
    held = f"±{_volts(limit_v)} in 90 days by the data sheet, ±{_volts(stated_v)} by the bench file"
    figures = [
        _figure(message(f"{channel} mean"), mean_v, held),
        _figure(
            message(f"{channel} standard deviation"),
            s_v,
            message(f"up to {_volts(most_s_v)} for {_volts(sigma_v)}"),
        ),
    ]
    wrong = []
    if abs(mean_v) > most_mean_v:
        wrong.append(f"{channel} reads {_volts(mean_v)}, more than {_volts(most_mean_v)} from zero")
    if s_v > most_s_v:
        wrong.append(f"{channel} scatters by {_volts(s_v)}, more than {_volts(most_s_v)}")
    return figures, wrong


def largest_scatter_v(sigma_v: float, n: int) -> float:
    """Return the limit, V, of the standard deviation of `n` samples with normal noise of `sigma_v`, V.

    Chance alone exceeds it with the probability `SIGNIFICANCE`; for one sample, it is `sigma_v`.
    """
    from scipy.stats import chi2

    return sigma_v * math.sqrt(float(chi2.isf(SIGNIFICANCE, n - 1)) / (n - 1)) if n > 1 else sigma_v


def zero_limit_v(evening: CommissioningSession, meter: Voltmeter) -> float:
    """Return the maker's limit of error, V, at a shorted input within 90 days of a calibration."""
    range_v = evening.file.voltmeter_range_v
    return range_v * _form(evening, meter).kind.accuracy[range_v][1]


def limit_v(evening: CommissioningSession, meter: Voltmeter, volts: float) -> float:
    """Return the maker's limit of error, V, at an input of `volts` within 90 days of a calibration."""
    of_reading, _ = _form(evening, meter).kind.accuracy[evening.file.voltmeter_range_v]
    return of_reading * abs(volts) + zero_limit_v(evening, meter)


def scatter_limit_v(evening: CommissioningSession, meter: Voltmeter, nplc: float) -> float:
    """Return the permitted standard deviation, V, of the samples of a steady input: the maker's resolution.

    If the meter's data state no resolution for `nplc`, return the limit of error at zero.
    """
    resolution = _form(evening, meter).kind.resolution
    within = [part for least, part in resolution.items() if least <= nplc]
    return evening.file.voltmeter_range_v * min(within) if within else zero_limit_v(evening, meter)


def _form(evening: CommissioningSession, meter: Voltmeter) -> VoltmeterForm:
    return next(section for section in evening.file.instruments.voltmeters if section.name == meter.name)


def _volts(value_v: float) -> str:
    scale = scale_for(abs(value_v), "V")
    return f"{value_v / scale.size:.3g} {scale.unit}"


def _figure(what: str, value_v: float, held: str) -> Figure:
    scale = scale_for(abs(value_v), "V")
    return Figure(what, value_v / scale.size, scale.unit, held)
