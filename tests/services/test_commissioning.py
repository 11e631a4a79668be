"""A whole commissioning on simulated benches: gone through, stopped, skipped, with one fault of each kind."""

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest

import bench.services.instruments as command
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.run.assembly.served import SimulatedBench, dry_evening
from bench.run.commission.session import CommissioningPerson
from bench.run.events import Wish
from bench.run.person import OperatorWish, RunControl
from bench.services.errors import Refused
from bench.services.instruments import PAGE, RESULT, WIRE_LOG, CommissioningPlan, commission
from drivers.person import Answer, Person, Prompt
from tests.support.schemas import keeps_to


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench file with a head on the network: a serial port that is dead costs its timeouts."""
    text = find_bench("bench-motorised").read_text(encoding="utf-8")
    assert '"ASRL/dev/ttyUSB0::INSTR"' in text
    file = tmp_path_factory.mktemp("bench") / "bench.yaml"
    file.write_text(
        text.replace('"ASRL/dev/ttyUSB0::INSTR"', '"TCPIP0::192.0.2.30::55550::SOCKET"'), encoding="utf-8"
    )
    return file


@pytest.fixture(scope="module")
def well(path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("commissioned") / "evening"
    return folder, carried_out(path, folder)


def carried_out(path: Path, folder: Path) -> dict:
    return commission(CommissioningPlan(load_bench(path), path, folder, None))


@contextmanager
def asking(person: Callable[[Person], Person]) -> Iterator[list[SimulatedBench]]:
    """Within the context a dry evening's person is this one, who has the scripted one; yield the benches."""
    seen: list[SimulatedBench] = []

    @contextmanager
    def evening(*arguments):
        with dry_evening(*arguments) as made:
            made.person = CommissioningPerson(person(made.person))
            seen.append(made)
            yield made

    with mock.patch.object(command, "dry_evening", evening):
        yield seen


class Interrupting:
    """Answers as the scripted person until a question contains `text`; there it raises."""

    def __init__(self, scripted: Person, text: str, error: BaseException) -> None:
        self.scripted, self.text, self.error = scripted, text, error

    def ask(self, prompt: Prompt) -> Answer:
        if self.text in prompt.text:
            raise self.error
        return self.scripted.ask(prompt)


def test_a_bench_that_is_well_and_takes_less_than_the_quarter_of_an_hour_promised(well) -> None:
    result = well[1]
    assert 300.0 < result["took_s"] < 900.0
    assert (result["status"], result["ended"], result["to_do"]) == (0, "", {})
    assert result["simulated"] is True
    assert {one["state"] for one in result["findings"]} == {"works"}
    checks = {one["check"] for one in result["findings"]}
    assert checks == {
        "limits", "identity", "settings", "time of a reading", "together", "noise, inputs shorted", "position",
        "small move", "stop", "temperature", "standby", "cable pulled", "cable plugged in again",
    }  # fmt: skip
    names = {one["name"] for one in result["instruments"]}
    assert names == {one["instrument"] for one in result["findings"]}


def test_page_result_and_wire_log_stand_in_the_folder(well) -> None:
    folder, result = well
    assert sorted(path.name for path in folder.iterdir()) == [PAGE, RESULT, WIRE_LOG]
    assert json.loads((folder / RESULT).read_text(encoding="utf-8")) == result
    keeps_to("commission", result)
    page = (folder / PAGE).read_text(encoding="utf-8")
    assert "SIMULATED" in page
    assert "Everything tested works as expected" in page
    log = (folder / WIRE_LOG).read_text(encoding="utf-8")
    for name in ("voltmeter.x", "head", "chamber"):
        assert f" {name} > " in log


def test_nothing_beyond_the_limits_was_ever_sent(well) -> None:
    """The head counts 4266.6667 steps a degree, within -5° to 365°; the chamber takes -40 to 85 °C."""
    lines = (well[0] / WIRE_LOG).read_text(encoding="utf-8").splitlines()
    moves = [int(line.rpartition("move abs ")[2]) for line in lines if "move abs " in line]
    assert len(moves) >= 3
    assert all(-5 * 4266.6667 <= steps <= 365 * 4266.6667 for steps in moves)
    assert not any("TEMP, S" in line for line in lines)


def test_a_folder_that_holds_one_is_refused(path, well) -> None:
    with pytest.raises(Refused, match="already holds a commissioning"):
        carried_out(path, well[0])
    (well[0] / "file").write_text("x", encoding="utf-8")
    with pytest.raises(Refused, match="cannot be written"):
        carried_out(path, well[0] / "file" / "below")
    (well[0] / "file").unlink()


@pytest.mark.parametrize("text", ["Part 1 ", "short their inputs", "half way", "Pull the cable of head"])
def test_ctrl_c_leaves_all_safe_and_writes_the_page(path: Path, tmp_path: Path, text: str) -> None:
    with asking(lambda scripted: Interrupting(scripted, text, KeyboardInterrupt())) as seen:
        result = carried_out(path, tmp_path / "out")
    assert (result["status"], result["ended"]) == (2, "stopped by a signal")
    assert "stopped by a signal" in (tmp_path / "out" / PAGE).read_text(encoding="utf-8")
    (evening,) = seen
    assert all(number() is None for number in evening.connections.values())


def test_a_signal_on_the_way_out_changes_nothing(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_safe = command.leave_safe
    left = []

    def disturbed(*arguments):
        signal.raise_signal(signal.SIGINT)
        left.append(leave_safe(*arguments))
        signal.raise_signal(signal.SIGINT)
        return left[0]

    monkeypatch.setattr(command, "leave_safe", disturbed)
    result = carried_out(path, tmp_path / "out")
    assert (result["status"], left) == (0, [{}])
    assert (tmp_path / "out" / PAGE).is_file()


def test_abort_and_a_mistake_of_the_program_write_the_page_too(path: Path, tmp_path: Path) -> None:
    for error, said in (
        (OperatorWish(RunControl(Wish.ABORT)), "the person ended the session"),
        (ZeroDivisionError("x"), "the program failed with ZeroDivisionError (x)"),
    ):
        out = tmp_path / type(error).__name__
        with asking(lambda scripted, error=error: Interrupting(scripted, "Part 2", error)):
            result = carried_out(path, out)
        assert (result["status"], result["ended"]) == (2, said)
        assert said in (out / PAGE).read_text(encoding="utf-8")


def test_what_is_skipped_stands_on_the_page_with_its_reason(path: Path, tmp_path: Path) -> None:
    wish = OperatorWish(RunControl(Wish.SKIP, "no <shorts> here"))
    with asking(lambda scripted: Interrupting(scripted, "short their inputs", wish)):
        result = carried_out(path, tmp_path / "out")
    skipped = [one for one in result["findings"] if one["state"] == "skipped"]
    assert [(one["check"], one["said"]) for one in skipped] == [("noise", "no <shorts> here")]
    assert result["status"] == 0
    page = (tmp_path / "out" / PAGE).read_text(encoding="utf-8")
    assert "no &lt;shorts&gt; here" in page
    assert "1 skipped" in page


def test_inputs_that_nobody_shorted_are_told(path: Path, tmp_path: Path) -> None:
    class Lazy:
        def __init__(self, scripted: Person) -> None:
            self.scripted = scripted

        def ask(self, prompt: Prompt) -> Answer:
            lazy = prompt.action["do"] == "select_input"
            return Answer(prompt.id, "yes") if lazy else self.scripted.ask(prompt)

    with asking(Lazy):
        result = carried_out(path, tmp_path / "out")
    wrong = [one for one in result["findings"] if one["state"] != "works"]
    assert [one["instrument"] for one in wrong] == ["voltmeter.z"]  # the one along the vertical: -1 g
    assert "short the input" in wrong[0]["remedy"]
    assert result["status"] == 1
