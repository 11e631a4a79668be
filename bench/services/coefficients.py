"""Coefficients of an earlier calibration, read from a file and converted to the forms of other programs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.files import from_text, read_given, write_whole
from bench.base.languages import message
from bench.base.numbers import read_number
from bench.base.text import cause_of, shortened
from bench.calibration.result import NOT_ACCEPTED_P, Component, Noise
from bench.exchange.result import BlockResult, FittedEffect
from bench.model.conditions import REFERENCE_C
from bench.model.effects import AT_REFERENCE, CATALOGUE, TEMPERATURE_EFFECTS
from bench.model.effects.base import Subsystem
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.table import UNITS, VERIFICATION
from bench.run.events import MANIFEST
from bench.services.errors import Refused, refusing

if TYPE_CHECKING:
    from bench.exchange.forms import ExportForm
    from bench.history.comparison import Snapshot

DEFAULT_K: Final = 2.0
"""Coverage factor of a result that states none."""

LARGEST: Final = 1e12
WORST: Final = 1e9
"""Results with coefficients above `LARGEST` belong to no block, nor does a K with a larger ratio than `WORST`.

The ratio is that of two elements, or the condition number.
"""

ROUNDING: Final = 1_000_000 * 2.0**-53
"""Largest rounding error of a correlation computed from a million readings."""


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of a block with covariance (12, 12), noise of a reading, and local gravity (m/s²).

    `simulated` says whether the instruments were simulated. `same_meters` (12, 12) is the covariance without
    the errors that cancel if the same meters read the block again; `meters` are the identities of the meters.
    Results of earlier versions lack both. Each column of `block_terms` (12, q) is the error of the
    coefficients due to one standard uncertainty of a nonlinearity K2 or K3 of the block. `wander` (3,) is the
    rms wander of each bias during a run. `block_name` is the type and serial number of the block, empty if not
    recorded. `temperature_c` is the temperature at which the coefficients hold, °C; NaN if it is unknown or if a
    model corrects for temperature. `fits` is false if the readings of the calibration contradict the model.
    `joined` is the source whose verification points joined the fit, empty if there is none. `channel_noise` (3,)
    is the noise of each channel, widened for the degrees of freedom of the estimate; None if only `noise` is known.
    `shared` are the errors that readings share.
    """

    block: Block
    covariance: Floats
    noise: float
    g_m_s2: float
    unit: str
    simulated: bool = False
    same_meters: Floats | None = None
    meters: tuple[str, ...] = ()
    gravity_u: float = 0.0
    made_at: str = ""
    block_terms: Floats | None = None
    wander: Floats | None = None
    block_name: str = ""
    temperature_c: float = math.nan
    fits: bool = True
    joined: str = ""
    channel_noise: Floats | None = None
    shared: tuple[Component, ...] = ()


def read_coefficients(path: Path, unit: str) -> Coefficients:
    """Return the coefficients in a file of `calibrate --json` for signals in `unit`. Raises `Refused`."""
    taken = coefficients_of(_read(path), str(path))
    if taken.unit != unit:
        raise Refused(
            f"{path}: the coefficients are in {taken.unit}/g, but the readings in {unit}; give the "
            f"coefficients of a calibration in {unit}/g"
        )
    return taken


def is_of_record(data: Any) -> bool:
    """Return whether parsed JSON is a calibration of meters from a record at a known input."""
    return isinstance(data, dict) and "channels" in data and "level_v" in data


def coefficients_of(data: Any, where: str) -> Coefficients:
    """Return the coefficients in a parsed result of `calibrate --json`; `where` is its file. Raises `Refused`."""
    if is_of_record(data):
        raise Refused(
            f"{where}: the file calibrates meters by a record at a known input, and has no coefficients of a "
            "block; give the calibration of a block"
        )
    try:
        values = np.array([_number(data["coefficients"][name]["value"]) for name in COEFFICIENTS])
        covariance = _covariance(data, "covariance")
        meters = tuple(str(name) for name in data.get("meters", ()))
        noise, g_m_s2 = _number(data["noise"]["reading_v"]), _number(data["g_m_s2"])
        theirs, per, simulated = data["unit"], data.get("per", "g"), data.get("simulated", False)
    except KeyError as error:
        raise _no_result(where, f": it has no {error}") from error
    except (ValueError, TypeError, IndexError, AttributeError) as error:
        raise _no_result(where, f" ({cause_of(error)})") from error
    right = {"unit": isinstance(theirs, str), "per": per == "g", "simulated": isinstance(simulated, bool)}
    if wrong := [name for name, well in right.items() if not well]:
        raise _no_result(where, f" (wrong: {', '.join(wrong)})")
    if noise < 0:
        raise Refused(f"{where}: its noise.reading_v is negative; calibrate again")
    if g_m_s2 <= 0:
        raise Refused(f"{where}: its g_m_s2 is not above 0; calibrate again")
    _refuse_impossible(covariance, where)
    return Coefficients(
        Block.from_vector(values),
        covariance,
        noise,
        g_m_s2,
        theirs,
        simulated,
        _further_covariance(data, "covariance_same_meters", where),
        meters,
        _positive(data.get("gravity_u")),
        _text(data.get("made_at")),
        _block_terms(data, where),
        _wander(data),
        _block_name(data),
        math.nan if _of_bias_or_scale(data) else _number_or(math.nan, data.get("temperature_c")),
        _fits(data),
        _text(data.get("source")) if _joins_verification(data) else "",
        _channel_noise(data["noise"]),
        tuple(_shared(data["noise"])),
    )


def _no_result(where: str, why: str) -> Refused:
    return Refused(
        f"{where}: not a result of 'bench calibrate --json'{why}; give a file that calibrate wrote"
    )


def _part(data: Any, name: str) -> Mapping[str, Any]:
    """Return the member `name` of a result; empty if it is missing or no object."""
    found = data.get(name)
    return found if isinstance(found, Mapping) else {}


def _block_name(data: Any) -> str:
    block = _part(data, "unit_under_test")
    return f"{_text(block.get('type'))} {_text(block.get('serial'))}".strip()


def _number_or(otherwise: float, value: object) -> float:
    try:
        return _number(value)
    except ValueError:
        return otherwise


def _fits(data: Any) -> bool:
    """Return whether the readings of a calibration fit the model; earlier versions state only the p-value."""
    stated, p = data.get("fits"), _part(data, "residual").get("p")
    return stated if isinstance(stated, bool) else not (isinstance(p, float) and p < NOT_ACCEPTED_P)


def _joins_verification(data: Any) -> bool:
    rows = _part(data, "free_positions").get("rows")
    return any(
        isinstance(row, Mapping) and row.get("installation") == VERIFICATION
        for row in (rows if isinstance(rows, list) else ())
    )


def block_result(data: Any, where: str) -> BlockResult:
    """Return a parsed result of `calibrate --json`, perhaps of an earlier version. Raises `Refused`."""
    taken = coefficients_of(data, where)
    if taken.unit not in UNITS.values():
        known = ", ".join(UNITS.values())
        raise Refused(
            f"{where}: the signals are in {shortened(repr(taken.unit))}, which no block gives; give a "
            f"calibration whose signals are in {known}"
        )
    _refuse_without_inverse(taken.block, taken.covariance, where)
    block, bench = _part(data, "unit_under_test"), data.get("bench")
    stated = {name: data["coefficients"][name] for name in COEFFICIENTS}
    factors = [_positive(entry.get("k")) for entry in stated.values()]
    expanded = {name: _positive(entry.get("U")) for name, entry in stated.items()}
    sizes, listed = _sizes(data), data.get("notes")
    return BlockResult(
        block=taken.block,
        covariance=taken.covariance,
        unit=taken.unit,
        g_m_s2=taken.g_m_s2,
        source=_text(data.get("source")) or where,
        block_type=_text(block.get("type")),
        serial=_text(block.get("serial")),
        made_at=_text(data.get("made_at")),
        bench={str(name): _text(said) for name, said in bench.items()}
        if isinstance(bench, Mapping)
        else None,
        simulated=taken.simulated,
        k=max((factor for factor in factors if factor), default=DEFAULT_K),
        expanded={name: size for name, size in expanded.items() if size},
        covariance_readings=_further_covariance(data, "covariance_readings", where),
        gravity_u=_positive(data.get("gravity_u")),
        certificates=tuple(_certificates(data.get("corrections"))),
        temperature=_temperature(data),
        temperature_c=holds_at(data),
        signs=_signs(data),
        fits=taken.fits,
        effects=tuple(_left_out(data)),
        nonlinearity=(sizes["K2"], sizes["K3"]) if sizes.keys() >= {"K2", "K3"} else (),
        notes=tuple(note for note in map(_text, listed if isinstance(listed, list) else ()) if note),
        temperature_u=sizes.get("temperature", ""),
    )


def _signs(data: Any) -> str:
    """Return the source of the scale factors' signs for free positions alone; "" for readings with orientation."""
    stated = data.get("by_convention")
    if isinstance(stated, Mapping):
        return _text(stated.get("signs")) or "positive"
    return "" if data.get("triangular") is None else "positive"  # of an earlier version


def _temperature(data: Any) -> str:
    """Return in words the temperature effects for which a result was corrected; "" for none."""
    used = _temperature_effects(data)
    return f"{' and '.join(used)} of its model, for which the coefficients are corrected" if used else ""


def _temperature_effects(data: Any) -> list[str]:
    """Return the effects of temperature for which a result was corrected; earlier versions list only some."""
    listed = data.get("temperature_effects")
    stated = [str(name) for name in listed] if isinstance(listed, list) else []
    fitted = (str(name).partition(".")[0] for name in _part(data, "effects"))
    return list(dict.fromkeys([*stated, *(n for n in fitted if n in {*TEMPERATURE_EFFECTS, *AT_REFERENCE})]))


def _of_bias_or_scale(data: Any) -> bool:
    """Return whether the result was corrected for the temperature of biases or scale factors."""
    return not set(TEMPERATURE_EFFECTS).isdisjoint(_temperature_effects(data))


def holds_at(data: Any) -> float:
    """Return the temperature at which the coefficients hold, °C; NaN if it is unknown."""
    if "holds_at_c" in data:
        return _number_or(math.nan, data["holds_at_c"])
    used = _temperature_effects(data)
    if any(name in AT_REFERENCE for name in used):
        return REFERENCE_C
    return math.nan if used else _number_or(math.nan, data.get("temperature_c"))


def _sizes(data: Any) -> dict[str, str]:
    """Return u in words of K2, K3 and the temperature of the block, as far as a result states them."""
    listed = data.get("sources")
    rows = [one for one in listed if isinstance(one, Mapping)] if isinstance(listed, list) else []
    plain = str.maketrans({"µ": "u", "²": "^2", "³": "^3", "±": "+-", "σ": " sigma"})
    sizes = {_text(one.get("name")): _text(one.get("size")).translate(plain) for one in rows}
    for one in rows:
        if one.get("name") == "temperature":
            sizes["temperature"] += f" ({_text(one.get('origin')).translate(plain)})"
    return sizes


def _left_out(data: Any) -> Iterator[FittedEffect]:
    """Yield the parameters of the block's effects in the model of a result: U = K a + U0 is what they leave."""
    for name, one in _part(data, "effects").items():
        effect = CATALOGUE.get(str(name).partition(".")[0])
        if isinstance(one, Mapping) and (effect is None or effect.subsystem is Subsystem.BLOCK):
            value, u = (_number_or(math.nan, one.get(key)) for key in ("value", "u"))
            yield FittedEffect(str(name), value, u, _text(one.get("unit")))


def require_temperature(results: Sequence[BlockResult], *, without: bool) -> None:
    """Raise `Refused` for results corrected for temperature, which no form can state, unless `without`."""
    for result in results:
        if result.temperature and not without:
            raise Refused(
                f"{result.source}: the coefficients are corrected for temperature ({result.temperature}), which "
                "these file formats cannot state; write them over temperature with 'bench compensate', or "
                "without the correction with --without-temperature"
            )


def _certificates(corrections: Any) -> Iterator[str]:
    """Yield each certificate that a result names, in words."""
    for one in corrections if isinstance(corrections, list) else ():
        if isinstance(one, Mapping) and _text(one.get("certificate")):
            expired = ", EXPIRED" if one.get("expired") is True else ""
            of = f"{_text(one.get('laboratory'))}, {_text(one.get('date'))}{expired}"
            yield f"{_text(one.get('instrument'))} {one['certificate']} ({of})"


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _positive(value: object) -> float:
    """Return a value of a result as a number; 0 if it is negative or not a number."""
    return max(_number_or(0.0, value), 0.0)


def _refuse_without_inverse(block: Block, covariance: Floats, where: str) -> None:
    """Raise `Refused` for a K without a usable inverse, and for numbers that no calibration produces."""
    largest = float(np.max(np.abs(block.vector)))
    if not largest < LARGEST or np.max(covariance) > LARGEST**2:
        raise Refused(
            f"{where}: the result has numbers beyond {LARGEST:g}; give a result that 'bench calibrate --json' "
            "wrote"
        )
    scale = float(np.min(np.abs(np.diag(block.K))))
    if scale <= largest / WORST or np.linalg.cond(block.K) > WORST:
        raise Refused(
            f"{where}: the matrix K of the result cannot be inverted; give the result of another calibration"
        )


def _further_covariance(data: Any, name: str, where: str) -> Floats | None:
    """Return the covariance (12, 12) in member `name` of a result, None without it. Raises `Refused`."""
    if data.get(name) is None:
        return None
    try:
        covariance = _covariance(data, name)
    except (ValueError, TypeError, IndexError) as error:
        raise _no_result(where, f" (its {name}: {error})") from error
    _refuse_impossible(covariance, where)
    return covariance


def _block_terms(data: Any, where: str) -> Floats | None:
    """Return the `block_terms` (12, q) of a result, see `Coefficients`; None without them. Raises `Refused`."""
    if data.get("block_terms") is None:
        return None
    try:
        rows = _numbers(data["block_terms"])
    except (ValueError, TypeError) as error:
        raise _no_result(where, f" (its block_terms: {error})") from error
    if any(len(row) != len(COEFFICIENTS) for row in rows):
        raise _no_result(where, " (its block_terms need 12 columns)")
    return np.array(rows).reshape(-1, len(COEFFICIENTS)).T


def _wander(data: Any) -> Floats | None:
    """Return the limits (3,) of the wander of each bias during a run; None if the result states none."""
    stated = data["noise"].get("wander")
    return np.array([_positive(stated.get(c)) for c in CHANNELS]) if isinstance(stated, dict) else None


def _channel_noise(noise: Any) -> Floats | None:
    """Return the widened noise (3,) of the channels; None if the result does not state it."""
    sizes = np.array([_positive(noise.get(c)) for c in CHANNELS])
    if not sizes.all():
        return None
    return widened_noise(
        sizes, _positive(noise.get("setting_arcsec")), _number_or(math.inf, noise.get("dof"))
    )


def widened_noise(by_channel: Floats, setting: float, dof: float) -> Floats:
    """Return the noise (3,) of the channels, widened for the `dof` of an estimate with the setting error."""
    return by_channel * Noise(1.0, setting, dof, "repeats").widened().reading


def _shared(noise: Any) -> Iterator[Component]:
    """Yield the errors that readings share, as far as a result states them."""
    listed = noise.get("shared")
    for one in listed if isinstance(listed, list) else ():
        if isinstance(one, dict) and (size := _positive(one.get("size"))):
            what, channels, unit = (_text(one.get(name)) for name in ("what", "channels", "unit"))
            yield Component(what, channels, size, unit, _number_or(math.inf, one.get("dof")), 0.0)


def _covariance(data: Any, name: str) -> Floats:
    """Return the covariance (12, 12) in member `name` of a result, in the order of `COEFFICIENTS`."""
    order = [list(data["order"]).index(coefficient) for coefficient in COEFFICIENTS]
    rows = _numbers(data[name])
    size = len(COEFFICIENTS)
    if [len(row) for row in rows] != [size] * size or len(data["order"]) != size:
        raise ValueError(f"expected {size} coefficients")
    return np.array(rows)[np.ix_(order, order)]


def _refuse_impossible(covariance: Floats, where: str) -> None:
    problem = impossible(covariance)
    if problem:
        raise Refused(
            f"{where}: {problem}; no calibration gives this; write it again with 'bench calibrate --json'"
        )


def _numbers(rows: Any) -> list[list[float]]:
    """Return rows of JSON numbers as floats; rows of only floats are checked fast. Raises `ValueError`."""
    if all(type(row) is list and set(map(type, row)) == {float} for row in rows):
        sums = [sum(row) for row in rows]  # a row with a non-finite entry has no finite sum
        if all(map(math.isfinite, sums)):
            return list(rows)
    return [[_number(entry) for entry in row] for row in rows]


def _number(value: Any) -> float:
    """Return a JSON number as a float. Raises `ValueError` for a text, a boolean or a number that is not finite."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{shortened(repr(value))} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError("a value is infinite or not a number")
    return number


def impossible(covariance: Floats) -> str:
    """Return why a matrix (n, n) of finite numbers is no covariance; "" if it may be one.

    Within rounding, a covariance is symmetric and has no negative variance, no correlation |r| above 1 and no
    negative eigenvalue. Each entry is computed as a sum of m products b_ik b_jk; m counts readings and items of
    prior knowledge. The rounding error of an entry is at most m u sqrt(c_ii c_jj) with u = 2^-53 (Higham, Accuracy
    and Stability of Numerical Algorithms, 2002, section 3.1, with the Cauchy-Schwarz inequality). The error of a
    correlation is at most `ROUNDING`; the error of an eigenvalue of the correlation matrix is at most n `ROUNDING`
    (Weyl).
    """
    variance = np.diag(covariance)
    if np.any(variance < 0):
        return "the covariance has a negative variance"
    u = np.sqrt(variance)
    scale = np.where(u > 0, u, 1.0)
    with np.errstate(over="ignore"):  # an overflow to infinity is found below
        r = covariance / scale / scale[:, None]
    if np.any(np.abs(r - r.T) > 2 * ROUNDING):
        return "the covariance is not symmetric"
    if np.any(np.abs(r) > np.where(np.outer(u, u) > 0, 1 + ROUNDING, 0.0)):
        return "the covariance has a correlation beyond 1"
    if np.linalg.eigvalsh(0.5 * (r + r.T)).min() < -len(r) * ROUNDING:
        return "the covariance gives a combination of coefficients a negative variance"
    return ""


def _read(path: Path) -> Any:
    try:
        with refusing("check name and permissions", path, reading=True):
            return from_text(read_given(path).decode())
    except ValueError as error:
        raise _no_result(str(path), message(", but text of another kind")) from error


def is_result(path: Path) -> bool:
    """Return whether `path` is a result file, and neither readings nor a run."""
    return path.is_file() and path.suffix.lower() == ".json" and path.name != MANIFEST


def results_in(path: Path) -> list[tuple[Any, str]]:
    """Return each result in a file of `calibrate --json`, with a name. Raises `Refused` for any other file."""
    data = _read(path)
    if not isinstance(data, list) or len(data) == 1:
        return [(data[0] if isinstance(data, list) else data, str(path))]
    return [(one, f"{path}, result {k}") for k, one in enumerate(data, 1)]


def snapshots_in(path: Path) -> list[Snapshot]:
    """Return the calibrations in a file of `calibrate --json`. Raises `Refused` for any other file."""
    return [snapshot_of(data, name) for data, name in results_in(path)]


def snapshot_of(data: Any, name: str) -> Snapshot:
    """Return the calibration in a parsed result of `calibrate --json`. Raises `Refused` for other data."""
    return dated(coefficients_of(data, name), name, _least_dof(data))


def dated(taken: Coefficients, name: str, dof: float) -> Snapshot:
    """Return coefficients as a dated calibration; `dof` is the smallest dof of its intrinsic numbers."""
    from bench.history.comparison import Snapshot

    return Snapshot(
        name, date_of(taken.made_at, name), taken.block_name, taken.unit, taken.g_m_s2, taken.block.vector,
        taken.covariance, taken.simulated, taken.same_meters, taken.meters, taken.block_terms, taken.wander, dof,
        taken.temperature_c, taken.gravity_u,
    )  # fmt: skip


def _least_dof(data: Any) -> float:
    """Return the smallest degrees of freedom of the nine numbers, else of the coefficients; infinite if unknown."""
    stated = _part(_part(data, "intrinsic"), "values") or data["coefficients"]
    rows = [one for one in stated.values() if isinstance(one, dict)]
    return min((dof for dof in (_positive(one.get("dof")) for one in rows) if dof), default=math.inf)


def date_of(text: str | None, where: str) -> datetime | None:
    """Return the ISO 8601 date in `text`, in UTC if it names no zone; None without text. Raises `Refused`."""
    if not text:
        return None
    try:
        date = datetime.fromisoformat(text)
    except (ValueError, TypeError):
        raise Refused(f"{where}: expected a date such as 2026-01-31, got {text!r}") from None
    return date if date.tzinfo else date.replace(tzinfo=UTC)


# --- forms in which others read coefficients -----------------------------------------------------------

ALL: Final = "all"


def forms_of(names: list[str]) -> list[ExportForm]:
    """Return the forms of these names, each once; "all" stands for all. Raises `Refused` for an unknown form."""
    from bench.exchange.forms import FORMS

    strange = [name for name in names if name not in FORMS and name != ALL]
    if strange:
        known = ", ".join([*FORMS, ALL])
        raise Refused(f"--as {', '.join(strange)}: choose from {known}")
    return [FORMS[name] for name in (FORMS if ALL in names else dict.fromkeys(names))]


def nominal_of(text: str | None, results: list[BlockResult]) -> Floats | None:
    """Return the scale factors (3,) in unit/g that `--nominal` states. Raises `Refused` for unsuitable ones."""
    if text is None:
        return None
    try:
        values = np.array([read_number(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.all(np.isfinite(values) & (values != 0)):
        raise Refused(
            f"--nominal {text}: give three scale factors in unit/g with their signs, such as -2.18,-2.14,-2.14"
        )
    for result in results:
        if result.unit in {"g", "m/s^2"}:
            raise Refused(
                f"--nominal: the signals of {result.source} are in {result.unit} already; leave out --nominal"
            )
        found = np.diag(result.block.K)
        if np.any(found * values < 0):
            raise Refused(
                f"--nominal {text}: {result.source} has scale factors of other signs; correct them "
                f"({', '.join(f'{v:.4g}' for v in found)} {result.unit}/g)"
            )
    return values


def write_form(
    result: BlockResult,
    path: Path,
    form: str,
    nominal: tuple[float, float, float] | None,
    *,
    without_temperature: bool = False,
) -> tuple[str, ...]:
    """Write a result in one form to a file; return what the form cannot hold. Raises `Refused`, `OSError`."""
    from bench.exchange.forms import FORMS

    if form not in FORMS:
        raise Refused(f"{form!r}: choose from {', '.join(FORMS)}")
    require_temperature([result], without=without_temperature)
    chosen = FORMS[form]
    factors = nominal_of(None if nominal is None else ",".join(map(repr, nominal)), [result])
    write_whole(path, chosen.write(result, factors))
    return tuple(chosen.loses(result, factors)) if chosen.loses else ()
