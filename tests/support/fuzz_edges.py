"""Unusual inputs: impossible or extreme values, units, pipes for files, a damaged catalogue, calls from Python."""

import datetime
import random
import re
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, Final

from benchmarks.campaign import ROOT
from tests.support.fuzz_inputs import WEIRD, Case, as_csv, as_yaml, at, places, readings, shipped

DIGITS: Final = {
    name: str.maketrans("0123456789", "".join(chr(zero + k) for k in range(10)))
    for name, zero in {"Arabic": 0x660, "Devanagari": 0x966, "wide": 0xFF10, "Thai": 0xE50}.items()
}
LONG: Final = 100_000
ANGLES: Final = ("axis_tilt", "zero_offset", "mounting_error", "setting_error")


def edge_case(rng: random.Random) -> Case:
    """Return readings or a bench file with a value that must be refused, or doubted in a sentence."""
    return rng.choice((_readings_case, _readings_case, _unit_case, _bench_case, _several_case))(rng)


def _with_columns() -> list[list[str]]:
    """Return valid readings with columns for time, temperature and scatter."""
    header, *rows = [list(row) for row in readings()]
    header += ["time_s", "temperature_c", "ux_sd_v"]
    return [header, *([*row, str(60 * k), "23.1", "1e-6"] for k, row in enumerate(rows))]


def _readings_case(rng: random.Random) -> Case:
    rows, refuse, doubt = _with_columns(), "", ""
    column = {name: k for k, name in enumerate(rows[0])}
    row = rows[rng.randrange(2, len(rows))]
    match rng.randrange(8):
        case 0:
            row[column["ux_sd_v"]] = rng.choice(("-1e-6", "-0.5", "-1e300"))
            refuse = "a negative standard deviation"
        case 1:
            row[column["ux_sd_v"]] = rng.choice(("50", "1e5", "1e30"))
            doubt = "check its unit"
        case 2:
            row[column["temperature_c"]] = rng.choice(("-273.2", "-1e5", "293.15", "296", "1e9"))
            refuse = "a temperature that no bench has"
        case 3:
            row[column["time_s"]] = rng.choice(("-5", "-1e9", "0.5"))
            doubt = "runs backwards"
        case 4:
            row[column[rng.choice(("pass", "point"))]] = rng.choice(("1000000000", "2147483647", "20261123"))
            refuse = "a pass by the billion"
        case 5 | 6:
            name = rng.choice(("pass", "point", "angle_deg", "ux_v", "time_s", "temperature_c", "ux_sd_v"))
            row[column[name]] = row[column[name]].translate(DIGITS[rng.choice(list(DIGITS))])
            refuse = f"digits of another alphabet in {name}"
        case _:
            name = rng.choice(("installation", "pass", "angle_deg", "ux_v", "direction", "temperature_c"))
            row[column[name]] = rng.choice(("x", "9", "é", " 1", "\x1b")) * LONG
            refuse = f"a value of 100 kB in {name}"
    command = rng.choice((["calibrate", "r.csv"], ["verify", "r.csv"], ["import", "r.csv", "--name", "r"]))
    if doubt:
        command = ["calibrate", "r.csv"]
    return Case([command], {"r.csv": as_csv(rows)}, refuse=refuse, doubt=doubt)


def _unit_case(rng: random.Random) -> Case:
    """Return signals in another unit: all of them, or those of a channel, a pass or an installation."""
    rows = [list(row) for row in readings()]
    factor = rng.choice((1e3, 1e6, 1e-3))
    channels = rng.choice(((5, 6, 7), (5,), (6,), (5, 7)))
    where, value = rng.choice(((None, ""), (None, ""), (1, "1"), (1, "2"), (0, "1"), (0, "2")))
    if where == 0:  # a channel that hardly changes in an installation does not show its unit there
        channels = (5, 6, 7)
    for row in rows[1:]:
        if where is None or row[where] == value:
            for k in channels:
                row[k] = repr(float(row[k]) * factor)
    whole = where is None and len(channels) == 3
    refuse, doubt = ("", "perhaps the signals are in") if whole else ("signals in two units", "seem to be in")
    return Case([["calibrate", "r.csv"]], {"r.csv": as_csv(rows)}, refuse=refuse, doubt=doubt)


def _bench_case(rng: random.Random) -> Case:
    tree = rng.choice(shipped("config"))
    data = as_yaml(tree).decode()
    match rng.randrange(3):
        case 0:
            name, size = rng.choice(ANGLES), rng.choice(("5 deg", "0.1 rad", "300 arcmin", "1e9 arcsec"))
            data = re.sub(rf"({name}:\s+limit: )\S+ \S+", rf"\g<1>{size}", data, count=1)
            refuse = f"{name} of {size}"
        case 1:
            found = [p for p in places(tree["stand"]) if p[-1:] == ("limit",)]
            place = rng.choice(found)
            kept = at(tree["stand"], place)
            changed = kept.translate(DIGITS[rng.choice(list(DIGITS))])
            data = data.replace(f"limit: {kept}", f"limit: {changed}", 1)
            refuse = "digits of another alphabet"
        case _:
            endless = rng.choice(("x ", "1", "9 V ")) * LONG
            data = re.sub(r"limit: \S+ \S+", f"limit: {endless}", data, count=1)
            refuse = "a limit of 100 kB"
    return Case([["check", "quick", "--bench", "b.yaml"]], {"b.yaml": data.encode()}, refuse=refuse)


def _several_case(rng: random.Random) -> Case:
    """Return three sources, one of which cannot be evaluated; the program must still evaluate the other two."""
    good = as_csv(readings())
    cut, renamed = good[: rng.randrange(200)], good.replace(b"ux_v", b"u")
    bad = rng.choice((b"", b"\xff", b"installation\n", cut, renamed))
    names = ["a.csv", "bad.csv", "c.csv"]
    rng.shuffle(names)
    command = [rng.choice(("calibrate", "verify")), *names, "--json", "-"]
    files = {"a.csv": good, "bad.csv": bad, "c.csv": good}
    return Case([command], files, refuse="one of three", doubt="1 of 3 sources could not be evaluated")


# --- pipes, a damaged catalogue, commands without input --------------------------------------------------


def special_case(rng: random.Random) -> Case:
    """Return a pipe in place of an input, or commands without anything to work on."""
    if rng.random() < 0.4:
        return Case([rng.choice(NOTHING)])
    command = rng.choice((
        ["calibrate", "pipe"], ["verify", "r.csv", "--coefficients", "pipe"], ["check", "pipe"],
        ["check", "paper", "--bench", "pipe"], ["calibrate", "r.csv", "--model", "pipe"],
        ["coefficients", "pipe"],
        ["compare", "pipe", "r.csv"], ["stability", "pipe"], ["tumble", "pipe"], ["import", "pipe", "--name", "x"],
        ["certificate", "verify", "pipe"], ["certificate", "read", "pipe"], ["show", "pipe"], ["seal", "pipe"],
        ["catalogue", "ask", "--catalogue", "pipe"], ["fleet", "prior", "pipe"],
        ["calibrate", "r.csv", "--json", "pipe"],
        ["calibrate", "r.csv", "--prior", "pipe"], ["diagnose", "pipe"], ["learn", "pipe"],
        ["confirm", "pipe", "--model", "pipe"],
    ))  # fmt: skip
    return Case([command], {"r.csv": as_csv(readings())}, refuse="a pipe that nobody writes", pipes=("pipe",))


_NOTHING = (
    "learn, calibrate, verify, diagnose, compare, show, resume, abort, export, import, report, chart, batch, "
    "confirm, accept, compensate, tumble, stability, seal, key, certificate, coefficients, fleet, catalogue, "
    "control, runs, plan-points, require, catalogue sync, catalogue sync none, catalogue ask, fleet prior, "
    "batch calibrate, chart none, learn none, runs --runs none, resume --runs none, batch calibrate none"
)
NOTHING: Final = [command.split() for command in _NOTHING.split(", ")]


def catalogue_case(rng: random.Random) -> Case:
    """Return a catalogue that is partly overwritten, cut short, or replaced by other bytes."""
    data = bytearray(_catalogue())
    match rng.randrange(4):
        case 0:
            data = data[: rng.randrange(len(data))]
        case 1:
            data = bytearray(rng.randbytes(rng.choice((1, 100, 20_000))))
        case _:
            for _ in range(rng.choice((1, 30, 2000))):
                data[rng.randrange(len(data))] = rng.randrange(256)
    ask = ["catalogue", rng.choice(("ask", "due")), "--catalogue", "c.sqlite"]
    return Case([ask], {"c.sqlite": bytes(data)})


@cache
def _catalogue() -> bytes:
    """Return a valid catalogue of one run."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.sync import sync

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "c.sqlite"
        with open_catalogue(file) as catalogue:
            sync(catalogue, [ROOT / "tests/data/records"], processes=1)
        return file.read_bytes()


# --- Python ------------------------------------------------------------------------------------------------

_VALUES: Final[tuple[Any, ...]] = (
    5, -1, 1.5, True, False, b"x", [], {}, (), [1], ("a", "b"), (1.0,), (1e-4, 1e-4), object(), float("nan"),
    10**400, 3j, datetime.date(2020, 1, 1), ["nonsense"], "x" * LONG, "\ud800", *WEIRD,
)  # fmt: skip
QUICK: Final = {
    "calibrate": "source", "verify": "source", "read_readings": "readings", "budget": "", "load_bench": "",
    "diagnose": "source", "learn": "sources", "chart": "runs", "confirm": "source", "dry_run": "procedure",
}  # fmt: skip
"""Public functions to call, with the parameter that each requires ("" for none)."""


def python_trial(rng: random.Random) -> list[tuple[str, str]]:
    """Call a public function with one invalid argument; it must return a result or raise a documented error."""
    import inspect

    import bench

    name = rng.choice(list(QUICK))
    function = getattr(bench, name)
    parameters = list(inspect.signature(function).parameters)
    given: dict[str, Any] = {}
    if QUICK[name]:
        Path("r.csv").write_bytes(as_csv(readings()))
        costly = name in {"diagnose", "learn", "chart", "confirm", "dry_run"}
        source = "none.csv" if costly else "r.csv"
        given[QUICK[name]] = [source] if name in {"learn", "chart"} else source
    if name == "confirm":
        given["model"] = "none.yaml"
    given[rng.choice(parameters)] = rng.choice(_VALUES)
    ours = (bench.Refused, bench.ReadingsError, bench.FileMistakes, bench.RecordError, bench.CalibrationError)
    try:
        function(**given)
    except ours as error:
        if len(str(error)) > 2000:
            return [("endless", f"{name}: {len(str(error))} characters")]
    return []


MADE_AT_EDGES: Final = {"edges": edge_case, "special": special_case, "catalogue": catalogue_case}
