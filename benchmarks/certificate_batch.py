"""How long does a certificate take, and how much memory do a thousand of them?

    python -m benchmarks.certificate_batch --certificates 1000

Runs are imported copies of one dry run of `quick`, every twentieth of them damaged: each of these is to be listed,
and to stop nothing. One certificate is evaluation, XML, PDF/A and register, unsigned (`--key FILE` signs). Printed:
time of a certificate (median, slowest; and of the processor, where others use the computer), the resident memory
after each tenth of the batch. Promised: a median under 2 s, and in the last nine tenths memory that grows by less
than a tenth. Exit status 1 when a promise is broken.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from bench.certificate.life import issue_all
from bench.certificate.signatory import signatory_of
from benchmarks.campaign import arguments
from benchmarks.certificate_desk import prepare
from drivers.clock import utc_now

BAD = 20


def resident_mb() -> float:
    """Return the resident memory now, MB, where the system tells; else the largest so far."""
    status = Path("/proc/self/statm")
    if status.is_file():
        return int(status.read_text().split()[1]) * resource.getpagesize() / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main(argv: list[str] | None = None) -> int:
    asked = arguments(__doc__, argv, certificates=1000, key={"metavar": "FILE", "help": "sign with this key"})
    with tempfile.TemporaryDirectory() as folder:
        desk, names = prepare(Path(folder), asked.certificates)
        if asked.key:
            desk = replace(desk, signatory=signatory_of(asked.key, None, lambda: b"", utc_now()))
        bad = set(names[BAD - 1 :: BAD])
        for name in bad:
            (desk.runs / name / "readings.csv").write_text("not readings\n", encoding="utf-8")
        times, memory, issued, listed = [], [], 0, 0
        before, begun = time.perf_counter(), time.process_time()
        for n, outcome in enumerate(issue_all(names, desk), start=1):
            now = time.perf_counter()
            if outcome.why:
                listed += 1
                if outcome.run not in bad:
                    print(f"{outcome.run}: {outcome.why}")
            else:
                issued += 1
                times.append(now - before)
            before = now
            if n % max(asked.certificates // 10, 1) == 0:
                memory.append(resident_mb())
        times.sort()
        median, grown = times[len(times) // 2], memory[-1] / memory[0] - 1.0
        print(f"{issued} issued, {listed} of {len(bad)} damaged ones listed, in {sum(times):.0f} s")
        worked = (time.process_time() - begun) / len(names)
        print(f"a certificate: median {median:.2f} s, slowest {times[-1]:.2f} s; processor {worked:.2f} s")
        print("resident memory, MB: " + " ".join(f"{size:.0f}" for size in memory))
        print(f"grown in the last nine tenths: {grown:.1%}")
        kept = issued == len(names) - len(bad) and listed == len(bad) and median < 2.0 and grown < 0.1
        return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
