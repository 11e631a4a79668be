"""Test `bench validate`: it must find planted faults, and no fault in healthy installations.

    python -m benchmarks.validation_campaign --healthy 10

For each fault, quick checks are carried out until one fails and names the place. The family that should find the
fault comes first, and files of packages are hashed again only for faults of packages. Healthy runs carry out all
checks, with each shipped bench file in turn and a different seed for their random parts. `--seeds` adds runs of the
checks with random parts alone, in their full size.
"""

import re
import sys
import tempfile
import time
from pathlib import Path

from bench.config.shipped import CONFIG, find_bench, shipped_folder
from bench.results.registers import ValidationCheck
from bench.services.validated import fingerprint
from bench.validation import gum, machine
from bench.validation.registry import Check, Context, carry_out, every
from benchmarks.campaign import arguments
from benchmarks.validation_faults import FAULTS, PlantedFault


def accepted(bench: Path) -> dict[str, object]:
    """Return the result of an accepted validation of this installation, as JSON data."""
    from bench.base.yaml_files import sha256_of_file

    return {
        "program": fingerprint().to_dict(),
        "machine": machine.description(),
        "bench": {"sha256": sha256_of_file(bench)},
    }


def found(fault: PlantedFault, bench: Path) -> tuple[list[ValidationCheck], bool]:
    """Return the failed checks up to the one that names the place of a fault, and whether there is such a check."""
    checks: list[Check] = sorted(every(), key=lambda one: not one.family.startswith(fault.family))
    if "package" not in fault.name:
        checks = [one for one in checks if one.name != "package files"]
    failed: list[ValidationCheck] = []
    with tempfile.TemporaryDirectory() as scratch:
        context = Context(bench, Path(scratch), quick=True, accepted=accepted(bench))
        with fault.plant(context) as spoilt:
            for one in checks:
                failed += [row for row in carry_out(spoilt, [one]) if not row.passed]
                if any(re.search(fault.place, f"{row.name} {row.where} {row.found}") for row in failed):
                    return failed, True
    return failed, False


def healthy(bench: Path, seed: int, random: bool = False) -> list[ValidationCheck]:
    """Return the failed checks on a healthy installation; `seed` replaces the seeds of the random parts.

    With `random`, only the checks with random parts are carried out, in their full size.
    """
    gum.SEED = 1000 + seed
    gum.SEED_OFFSET = 1000 + seed
    with tempfile.TemporaryDirectory() as scratch:
        context = Context(bench, Path(scratch), quick=not random, accepted=accepted(bench))
        checks = [one for one in every() if one.name != "package files" or seed == 0]
        checks = [one for one in checks if one.p_false or not random]
        return [row for row in carry_out(context, checks) if not row.passed]


def alarms_of(which: str, file: Path, seed: int) -> int:
    """Return 1 if a healthy installation gives a false alarm, 0 otherwise; print what failed."""
    failed = healthy(file, seed, random=which == "seed")
    said = "; ".join(f"{one.name}: {one.found}" for one in failed) or "passed"
    print(f"{which} {seed} {file.stem}: {said}", flush=True)
    return int(bool(failed))


def main() -> int:
    asked = arguments(
        __doc__,
        only=("", "pattern of the names of faults"),
        healthy=50,
        seeds=(0, "further runs of the checks with random parts alone"),
        first=(0, "number of the first healthy run, which gives its seed and bench file"),
    )
    bench = find_bench("paper-stand")
    chosen = [fault for fault in FAULTS if re.search(asked.only, fault.name)]
    seen = named = 0
    for fault in chosen:
        began_s = time.monotonic()
        failed, placed = found(fault, bench)
        seen, named = seen + bool(failed), named + placed
        words = (
            f"{failed[-1].name}: {failed[-1].found[:70]} [{failed[-1].where[:50]}]" if failed else "NOT FOUND"
        )
        print(
            f"{time.monotonic() - began_s:5.1f} s {'' if placed else 'NO PLACE '}{fault.name}: {words}",
            flush=True,
        )
    print(f"{seen} of {len(chosen)} faults found, {named} with their place", flush=True)
    benches = sorted(shipped_folder(CONFIG).glob("*.yaml"))
    numbers = range(asked.first, asked.first + asked.healthy)
    alarms = sum(alarms_of("healthy", benches[number % len(benches)], number) for number in numbers)
    print(f"{alarms} false alarms in {asked.healthy} healthy runs", flush=True)
    by_chance = sum(alarms_of("seed", bench, seed) for seed in range(asked.first, asked.first + asked.seeds))
    print(f"{by_chance} false alarms in {asked.seeds} runs of the checks with random parts", flush=True)
    return 0 if named >= len(chosen) - 2 and not alarms + by_chance else 1


if __name__ == "__main__":
    sys.exit(main())
