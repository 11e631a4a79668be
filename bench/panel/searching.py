"""The search for instruments, and the test of a bench's instruments, by a process that the panel starts."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from bench.base.files import from_text, read_regular, to_text, write_whole
from bench.base.languages import message
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.panel.access import Refusal, private_folder
from bench.panel.launching import FOUND, WorkFolder, start
from bench.services.errors import Refused
from drivers.clock import utc_now
from drivers.interfaces import BenchError

ASKED: Final = "asked.json"
LOG: Final = "search.log"
OFFERS: Final = "offers"
IDENTIFY: Final = "identify"
TEST: Final = "test"
MOST_ADDRESSED: Final = 30
BEGINS_WITHIN_S: Final = 20.0


@dataclass(frozen=True)
class Findings:
    """What a search found: `resources` (`FoundResource`), or the results of testing the `instruments` of `bench`.

    `what` is the kind of request (`OFFERS`, `IDENTIFY` or `TEST`), `problem` the reason why it was not carried out.
    """

    what: str = ""
    done: bool = True
    resources: Sequence[Mapping[str, str]] = ()
    notes: Sequence[str] = ()
    instruments: Sequence[Mapping[str, Any]] = ()
    bench: str = ""
    problem: str = ""
    when: str = ""
    resources_when: str = ""
    order: Sequence[str] = ()
    """The resources that are addressed."""


class Search(WorkFolder):
    """The latest search of a panel, in a folder of its own; one search at a time addresses the instruments."""

    def found(self) -> Findings:
        """Return the findings so far; they are empty before the first search."""
        try:
            told = from_text(read_regular(self.path / FOUND))
            return Findings(**told)
        except (OSError, ValueError, TypeError):
            return Findings()

    def at_work(self) -> bool:
        """Return whether a search process is running, or was started so recently that it may not have begun yet."""
        if self.found().done:
            return False
        try:
            age_s = utc_now().timestamp() - (self.path / ASKED).stat().st_mtime
        except OSError:
            age_s = BEGINS_WITHIN_S
        return age_s < BEGINS_WITHIN_S or super().at_work()

    def begin(self, what: str, *, resources: Sequence[str] = (), bench: Path | None = None) -> None:
        """Start a search, an identification of `resources`, or a test of the file `bench`; `what` says which.

        Raises `Refusal` if a search is running, or for invalid or too many resources.
        """
        from bench.services.search import checked_resource

        private_folder(self.path)
        if self.at_work():
            raise Refusal(409, "a search is running; wait until it ends")
        if len(resources) > MOST_ADDRESSED:
            raise Refusal(400, f"at most {MOST_ADDRESSED} resources can be addressed at once; choose fewer")
        try:
            order = list(dict.fromkeys(map(checked_resource, resources)))
        except Refused as mistake:
            raise Refusal(400, mistake.typed) from mistake
        before = self.found()
        found = Findings(
            what,
            done=False,
            resources=() if what == OFFERS else before.resources,
            notes=() if what == OFFERS else before.notes,
            resources_when=before.resources_when,
            bench="" if bench is None else str(bench.absolute()),
            when=utc_now().isoformat(),
            order=order,
        )
        write_whole(self.path / ASKED, to_text({"what": what}))
        self.tell(found)
        start([str(self.path.absolute())], self.path / LOG, program=("-m", "bench.panel.searching"))


# --- the process: python -m bench.panel.searching FOLDER ----------------------------------------------


def main() -> None:
    """Carry out the search whose folder is on the command line."""
    search = Search(Path(sys.argv[1]))
    with search.lock():
        asked = search.found()
        try:
            search.tell(carried_out(asked))
        except BaseException as error:
            told = asdict(asked) | {
                "done": True,
                "problem": message(f"it stopped ({type(error).__name__}: {error})"),
            }
            search.tell(Findings(**told))
            raise


def carried_out(asked: Findings) -> Findings:
    """Carry out the request in `asked`; return the findings."""
    from bench.services.search import FoundResource, identified, offered

    told = asdict(asked) | {"done": True}
    if asked.what == OFFERS:
        resources, notes = offered()
        told |= {
            "resources": [one.to_json() for one in resources],
            "notes": notes,
            "resources_when": asked.when,
        }
    elif asked.what == IDENTIFY:
        rows = {one["resource"]: FoundResource(**one) for one in asked.resources}
        for resource in asked.order:
            rows[resource] = identified(resource, rows[resource].what if resource in rows else "")
        told |= {"resources": [one.to_json() for one in rows.values()], "resources_when": asked.when}
    else:
        told |= _tested(Path(asked.bench))
    return Findings(**told)


def _tested(bench: Path) -> dict[str, Any]:
    """Test the instruments of a bench file; return results, or the problem, as members of `Findings`."""
    from bench.config.bench_file.file import load_bench
    from bench.run.interrupts import Interrupts
    from bench.services.instruments import look_at

    try:
        file = load_bench(bench)
        with Interrupts() as interrupts:
            rows = look_at(file, None, interrupts.haste)
    except (FileMistakes, BenchError, OSError) as problem:
        return {"problem": visible(str(problem))}
    return {"instruments": [_row(row.part.to_dict()) for row in rows]}


def _row(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the members of a tested instrument that the page shows."""
    identity = part["identity"] or {}
    failures = [": ".join(filter(None, map(str, failure.values()))) for failure in part["failures"]]
    return {
        "name": part["name"],
        "identity": " ".join(str(one) for one in identity.values() if one),
        "self_test": part["self_test"],
        "shows": part["shows"],
        "failures": failures,
    }


if __name__ == "__main__":
    main()
