"""The watch over the wires: times of answers, failures, and all of it passed on."""

from bench.run.commission.session import WireWatch
from sim.world.clock import VirtualClock


def test_the_time_of_an_answer_is_from_its_command_on_and_of_its_instrument():
    clock, logged = VirtualClock(), []
    watch = WireWatch(lambda *message: logged.append(message), clock.now_s)
    watch("x", ">", "*IDN?")
    clock.sleep(0.1)
    watch("y", ">", "TEMP?")
    mark = watch.mark()
    clock.sleep(0.2)
    watch("x", "<", "M1")
    watch("y", "!", "after sending: InstrumentLost: gone; look")
    watch("y", "<", "too late")
    (exchange,) = watch.exchanges(mark, "x")
    assert (exchange.command, round(exchange.took_s, 9)) == ("*IDN?", 0.3)
    assert watch.exchanges(mark, "y") == []
    assert watch.failures(mark, "y") == ["after sending: InstrumentLost: gone; look"]
    assert watch.failures(mark, "x") == watch.failures(watch.mark(), "y") == []
    assert [direction for _, direction, _ in logged] == [">", ">", "<", "!", "<"]
