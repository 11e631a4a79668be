"""Programs that write a register at once, and are killed: no number is lost, none is given twice."""

import os
import random
import signal
import time

import pytest

from bench.certificate.register import ISSUED, LINES, Entry, opened

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")]

SEED = 20261122


def program(folder, name, certificates):
    """Let another program issue certificates; return its process."""
    process = os.fork()
    if process:
        return process
    try:
        for n in range(certificates):
            with opened(folder) as register:
                number = register.number_after(str(k) for k in range(1, 10_000))
                data = {"record": {"head": f"{name}-{n}"}}
                entry = Entry(ISSUED, number, "2026-11-22T12:00:00+00:00", name, data)
                content = f"{name} {n} ".encode() * 2_000
                register.issue(entry, {f"{number}.xml": content, f"{number}.pdf": content[::-1]})
    finally:
        os._exit(0)


def check(folder):
    """Check what stands in a folder of a register; return how many certificates there are."""
    with opened(folder) as register:
        assert register.damaged_files() == []
        numbers = [int(number) for number in register.standings]
        known = {name for standing in register.standings.values() for name in standing.entry.files}
    assert numbers == list(range(1, len(numbers) + 1))
    assert {path.name for path in folder.iterdir()} == known | {LINES, ".register.lock"}
    return len(numbers)


def test_two_programs_at_once_give_each_number_once(tmp_path):
    for process in [program(tmp_path, name, 8) for name in "ab"]:
        assert os.waitpid(process, 0)[1] == 0
    assert check(tmp_path) == 16
    with opened(tmp_path) as register:
        assert {standing.entry.by for standing in register.standings.values()} == {"a", "b"}


def test_killed_at_random_moments_a_register_stays_whole(tmp_path):
    moments = random.Random(SEED)  # noqa: S311 - moments, no secrets
    before, killed = 0, 0
    for _ in range(8):
        processes = [program(tmp_path, name, 50) for name in "ab"]
        time.sleep(moments.uniform(0.0, 0.06))
        for process in processes:
            os.kill(process, signal.SIGKILL)
            killed += os.WIFSIGNALED(os.waitpid(process, 0)[1])
        after = check(tmp_path)
        assert after >= before
        before = after
    assert killed > 0
