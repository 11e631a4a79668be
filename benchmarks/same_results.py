"""Compare the results of two versions of the program: store those of each, then compare.

    python -m benchmarks.same_results store OLD --program /path/of/old/.venv/bin/bench --seeds 50
    python -m benchmarks.same_results store NEW --program .venv/bin/bench --seeds 50
    python -m benchmarks.same_results compare OLD NEW
    python -m benchmarks.same_results schemas /path/of/old/docs/schemas

`store` makes seeded dry runs and stores the JSON, pages, records, readings and draft certificates of every
command that evaluates them. It calls the program as a user does, so that it can store what an older version
gives. `compare` requires that JSON and XML have the same members, texts and integers, and that numbers agree
to 1e-9 (`--within`) of the largest number in the same list. Of pages it compares the numbers of the text and
the plotted data. Texts that differ in words alone are listed as reworded, which is no difference. `IGNORED`
lists the members whose values are not compared. The exit status is 1 if anything differs. `schemas` requires
that this version's JSON schemas have every member of the schemas in a folder, and lists new members.
"""

import csv
import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from benchmarks.campaign import amiss, arguments, refuse

PROCEDURES: Final = ("paper", "quick", "calibration", "paper", "turn-12", "remount-180")
COMMANDS: Final = {
    "calibrate": "calibrate r", "calibrate-closed-form": "calibrate r --estimator closed-form",
    "calibrate-robust": "calibrate r --estimator robust --join-verification",
    "calibrate-together": "calibrate r s", "verify": "verify r", "verify-simple": "verify r --rule simple",
    "diagnose": "diagnose r --out diagnosis", "budget": "budget --procedure quick --trials 2200",
    "require": "require --accuracy 3e-4 --procedure quick", "plan-points": "plan-points --u all=2e-4",
    "check": "check paper", "runs": "runs", "show": "show r --verify", "compare": "compare r s",
    "tumble": "tumble r", "report": "report r",
    "coefficients": "coefficients r --as all --out coefficients",
    "certificate": "certificate issue r --draft --out draft", "learn": "learn r s --out learned.yaml",
}  # fmt: skip
"""The commands, by the name under which their results are stored; each also writes `--json`."""
FREE_OF_SEED: Final = {"budget", "require", "plan-points", "check"}
IGNORED: Final = (
    r"(^|[._])(created|made|time|when|date|begun|ended|at|took|takes|age|elapsed|duration)(_s|_utc|_at)?$",
    r"(^|[._])(versions?|program|python|platform|packages?|hash|sha256|head|chain|digest|id|uuid|pid|host|user)$",
    r"(^|[._])(path|folder|file|files|page|report|model_file)$",
    r"[Ss]ignature|[Ii]dentifier|release|[Tt]imestamp|free_bytes$|\.prev$",
)
"""Patterns of members whose values are not compared, only their presence.

They are times, versions, identifiers, places and signatures.
"""
_NUMBER: Final = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_CLOCK: Final = r"\d\d:\d\d(?::\d\d(?:\.\d+)?)?"
_TIME: Final = rf"\d{{4}}-\d\d-\d\d(?:[T ]{_CLOCK}(?:Z|[+-]\d\d:\d\d)?)?|{_CLOCK}"
_PASSING: Final = re.compile(rf"(?<![\w.])(?=\d*[a-f])[0-9a-f]{{12,64}}\b|(?:/[\w.+-]+){{2,}}|{_TIME}")
"""Pattern of digests, places and times in texts, which are not compared."""


def store(folder: Path, program: str, seeds: int) -> None:
    """Store the results of a program for `seeds` seeds; existing ones are kept."""
    for seed in range(1, seeds + 1):
        place = folder / f"seed-{seed:03}"
        if (place / "done").exists():
            continue
        place.mkdir(parents=True, exist_ok=True)
        procedure = PROCEDURES[seed % len(PROCEDURES)]
        for run, its_seed in (("r", seed), ("s", 1000 + seed)):
            _call(program, place, f"run-{run}", f"run {procedure} --dry-run --seed {its_seed} --name {run}")
        for name, words in COMMANDS.items():
            if seed == 1 or name not in FREE_OF_SEED:
                _call(program, place, name, f"{words} --json {name}.json")
        _call(program, place, "export", "export r --csv readings.csv")
        (place / "done").touch()
        print(f"seed {seed} of {seeds}", flush=True)


def _call(program: str, place: Path, name: str, words: str) -> None:
    done = subprocess.run([program, *words.split()], cwd=place, capture_output=True, text=True, check=False)  # noqa: S603
    (place / f"{name}.status").write_text(f"{done.returncode}\n", encoding="utf-8")
    (place / f"{name}.txt").write_text(done.stdout + done.stderr, encoding="utf-8")


class Differences:
    """Lines on differences, and on texts that are only reworded; numbers may differ by the fraction `within`."""

    def __init__(self, within: float = 1e-9) -> None:
        self.within = within
        self.different: list[str] = []
        self.reworded: list[str] = []
        self.files = 0

    def values(self, where: str, one: Any, other: Any, scale: float = 0.0) -> None:
        """Compare two JSON values; numbers in a list must agree to `within` of its largest number."""
        if any(re.search(pattern, where) for pattern in IGNORED) and (one is None) == (other is None):
            return
        match one, other:
            case dict(), dict():
                if one.keys() != other.keys():
                    self.different.append(f"{where}: members {sorted(one.keys() ^ other.keys())}")
                for key in one.keys() & other.keys():
                    self.values(f"{where}.{key}", one[key], other[key])
            case list(), list():
                if len(one) != len(other):
                    self.different.append(f"{where}: {len(one)} and {len(other)} items")
                largest = max((abs(x) for x in _floats(one)), default=0.0)
                for index, pair in enumerate(zip(one, other, strict=False)):
                    self.values(f"{where}[{index}]", *pair, scale=max(scale, largest))
            case float(), float():
                if not math.isclose(one, other, rel_tol=self.within, abs_tol=self.within * scale):
                    self.different.append(f"{where}: {one!r} and {other!r}")
            case str(), str():
                self.text(where, one, other)
            case _:
                if one != other or type(one) is not type(other):
                    self.different.append(f"{where}: {one!r} and {other!r}")

    def text(self, where: str, one: str, other: str) -> None:
        """Compare two texts: their numbers must agree; if only words differ, they count as reworded."""
        one, other = (_PASSING.sub("…", text) for text in (one, other))
        if one == other:
            return
        mine, theirs = ([_number(found) for found in _NUMBER.findall(text)] for text in (one, other))
        sentence = " " in one.strip() and " " in other.strip()
        if sentence and len(mine) == len(theirs) and all(map(self._near, mine, theirs)):
            self.reworded.append(f"{where}: {one[:100]!r} is {other[:100]!r}")
        else:
            self.different.append(f"{where}: {one[:100]!r} and {other[:100]!r}")

    def _near(self, one: float, other: float) -> bool:
        return math.isclose(one, other, rel_tol=self.within, abs_tol=1e-300)


def _floats(value: Any) -> Iterator[float]:
    if isinstance(value, list):
        for item in value:
            yield from _floats(item)
    elif isinstance(value, float) and math.isfinite(value):
        yield value


def _number(text: str) -> float:
    return float(text.replace("−", "-"))


class Page(HTMLParser):
    """The text of a page, line by line, and the data of its plots."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.lines: list[str] = []
        self.plotted: list[list[float]] = []
        self._hidden = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the coordinates of lines and markers."""
        if tag in {"style", "script", "metadata"}:
            self._hidden = tag
        told = dict(attrs)
        for name in ("d", "points", "x", "y", "transform"):
            if numbers := _NUMBER.findall(told.get(name) or ""):
                self.plotted.append([_number(found) for found in numbers])

    def handle_endtag(self, tag: str) -> None:
        """Note the end of an element that is not shown."""
        if tag == self._hidden:
            self._hidden = ""

    def handle_data(self, data: str) -> None:
        """Collect the visible text."""
        if not self._hidden and data.strip():
            self.lines.append(" ".join(data.split()))


def _read(path: Path) -> Any:
    """Return the part of a file that is compared."""
    match path.suffix:
        case ".xml":
            return list(_leaves(ElementTree.parse(path).getroot()))  # noqa: S314 - ours
        case ".json":
            return json.loads(path.read_text(encoding="utf-8"))
        case ".html":
            return Page(path.read_text(encoding="utf-8"))
        case ".jsonl":  # each event without hashes and civil times
            return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        case ".csv":
            return list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    return path.read_text(encoding="utf-8")


def _compare_files(found: Differences, where: str, one: Path, other: Path) -> None:
    mine, theirs = _read(one), _read(other)
    if one.suffix == ".html":
        found.values(f"{where}:plots", mine.plotted, theirs.plotted)
        found.text(where, "\n".join(mine.lines), "\n".join(theirs.lines))
    elif one.suffix == ".xml":
        found.values(f"{where}:elements", [name for name, _ in mine], [name for name, _ in theirs])
        for (name, text), (_, said) in zip(mine, theirs, strict=False):
            found.values(f"{where}:{name}", text, said)
    elif isinstance(mine, str):
        found.text(where, mine, theirs)
    else:
        found.values(where, mine, theirs)


def _leaves(element: ElementTree.Element, path: str = "") -> Iterator[tuple[str, str]]:
    here = f"{path}.{element.tag.rpartition('}')[2]}"
    yield here, (element.text or "").strip()
    for child in element:
        yield from _leaves(child, here)


COMPARED: Final = (".json", ".html", ".xml", ".csv", ".jsonl", ".status", ".h")
"""Suffixes of the files that are compared; of other files (PDF, logs, output), only the presence counts."""


def compare(one: Path, other: Path, within: float = 1e-9) -> Differences:
    """Compare two stores file by file, for the seeds that are complete in both."""
    found = Differences(within)
    seeds, others = ({done.parent.name for done in top.glob("seed-*/done")} for top in (one, other))
    both = seeds & others
    mine, theirs = (
        {p.relative_to(top) for seed in both for p in (top / seed).rglob("*") if p.is_file()}
        for top in (one, other)
    )
    found.different += [f"{path}: in one store alone" for path in sorted(mine ^ theirs)]
    for path in sorted(mine & theirs):
        if path.suffix in COMPARED:
            _compare_files(found, str(path), one / path, other / path)
            found.files += 1
    if not found.files:
        found.different.append(f"{one} and {other} have no file that could be compared")
    return found


Defs = dict[str, Any]


def members(
    schema: Defs, defs: Defs, path: str = "", seen: tuple[str, ...] = ()
) -> Iterator[tuple[str, bool]]:
    """Yield the path of each member of a JSON schema, and whether the member is always present."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        if name not in seen:
            yield from members(defs[name], defs, path, (*seen, name))
        return
    for name, member in schema.get("properties", {}).items():
        yield f"{path}.{name}", name in schema.get("required", ())
        yield from members(member, defs, f"{path}.{name}", seen)
    inside = {
        path: [one for key in ("anyOf", "oneOf", "allOf") for one in schema.get(key, ())],
        f"{path}.{{}}": [schema.get("additionalProperties")],
        f"{path}[]": [schema.get("items"), *schema.get("prefixItems", ())],
    }
    for below, parts in inside.items():
        for part in parts:
            if isinstance(part, dict):
                yield from members(part, defs, below, seen)


def compare_schemas(older: Path) -> list[str]:
    """Print how this version's schemas differ from older ones; return the members that they lack."""
    from docs.generators.schemas import RESULTS, schema_of

    lacking = []
    for path in sorted(older.glob("*.json")):
        name = path.stem
        before = json.loads(path.read_text(encoding="utf-8"))
        if name not in RESULTS:
            lacking.append(f"{name}: the whole schema")
            continue
        now = schema_of(name)
        old, new = (dict(members(one, one.get("$defs", {}))) for one in (before, now))
        lacking += [f"{name}: {member}" for member in old.keys() - new.keys()]
        for member in sorted(new.keys() - old.keys()):
            print(f"more      {name}: {member}")
        for member in sorted(m for m in old.keys() & new.keys() if old[m] != new[m]):
            print(f"changed   {name}: {member} was {'always' if old[member] else 'not always'} there")
    return lacking


def main() -> None:
    given = arguments(
        __doc__, does={"positional": True, "choices": ("store", "compare", "schemas")},
        folders={"positional": True, "nargs": "+", "type": Path, "help": "one, to compare two"},
        program="bench", seeds=50, within=(1e-9, "largest relative difference of two equal numbers"),
    )  # fmt: skip
    if len(given.folders) != (2 if given.does == "compare" else 1):
        refuse(f"{given.does} takes {'two folders' if given.does == 'compare' else 'one folder'}")
    if given.does == "store":
        store(given.folders[0], given.program, given.seeds)
        return
    if given.does == "schemas":
        sys.exit(amiss(compare_schemas(given.folders[0]), "lacks    "))
    one, other = given.folders
    found = compare(one, other, given.within)
    amiss(found.reworded, "reworded ")
    status = amiss(found.different, "different")
    told = f"{len(found.different)} differences, {len(found.reworded)} reworded texts"
    print(f"{told}, {found.files} files compared")
    sys.exit(status)


if __name__ == "__main__":
    main()
