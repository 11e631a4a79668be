"""Every way out of a run leaves the simulated bench safe: chamber in standby, head still."""

import contextlib
from datetime import UTC, datetime

import pytest

from bench.config.procedure.plan import Mount, Plan, Read, SetTemperature, Turn
from bench.model import ForwardModel
from bench.run.assembly.served import dry_bench
from bench.run.events import RunState, Wish
from bench.run.person import RunControl
from bench.run.record import Record, read_history
from bench.run.runner import RunAborted
from drivers.interfaces import BenchError
from tests.support.composed_bench import edited
from tests.support.runner_bench import Wishing, runner_of

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)
STEPS = (
    SetTemperature("1/temperature", 40.0),
    Mount("2/mount", "1", 1),
    Turn("3/turn", "1", 1, 1, 1, 0.5, 1),
    Read("4/read", "1", 1, 1, 1, 0.5, 1, 2, 1.0),
    Turn("5/turn", "1", 1, 1, 2, 1.0, 1),
)


@pytest.mark.parametrize(
    ("trouble", "state"),
    [
        (None, RunState.FINISHED),
        (KeyboardInterrupt(), RunState.INTERRUPTED),
        (BenchError("voltmeter.x", "it smokes", "pull the plug"), RunState.FAILED),
        (RunControl(Wish.ABORT, "wrong block"), RunState.ABORTED),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_every_way_out_leaves_the_bench_safe(tmp_path, monkeypatch, trouble, state):
    served = {}
    monkeypatch.setattr("bench.run.assembly.served.SimulatedBench", _remembering(served))
    bench = edited(tmp_path, "bench-motorised")
    record = Record.create(tmp_path / "run", {}, {}, lambda: NOON)
    with dry_bench(bench, ForwardModel(bench.installation_models()), seed=1) as assembly:
        runner = runner_of(
            Plan("p", STEPS, ""),
            assembly.instruments,
            assembly.person,
            assembly.clock,
            record,
            range_v=bench.voltmeter_range_v,
            observers=assembly.observers,
            controls=Wishing(trouble, 4),
        )
        with contextlib.suppress(KeyboardInterrupt, BenchError, RunAborted):
            runner.run()
        world = served["bench"].world
        assert world.head_rate_rad_s == 0.0
        chamber = served["bench"].dialects["chamber"]
        assert b"STANDBY" in (chamber.handle(b"MODE?", lambda: False) or b"")
        assembly.clock.sleep(24 * 3600.0)
        assert world.chamber_c == pytest.approx(world.settings.ambient_c, abs=0.1)
    record.close()
    assert read_history(tmp_path / "run").state is state


def _remembering(served):
    from sim.bench import SimulatedBench

    def make(*arguments, **options):
        served["bench"] = SimulatedBench(*arguments, **options)
        return served["bench"]

    return make
