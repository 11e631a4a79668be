"""What every voltmeter must do: volts, limits before the wire, settings proved, overload and lost power told."""

import re

import numpy as np
import pytest

from drivers.interfaces import BadReading, BenchError, InstrumentLost, InstrumentRefused, LimitExceeded
from tests.support.instrument_stand import Cutting, known, skip_if_own, standing, taking

voltmeters = pytest.mark.parametrize("device", known("voltmeter"), ids=lambda device: device.name)


def reading(stand):
    stand.driver.start()
    return stand.driver.fetch()


@voltmeters
def test_it_can_what_its_bench_file_allows(device, tmp_path):
    with standing(device, tmp_path) as stand:
        kind, limits = stand.section.kind, stand.driver.limits
        assert limits == kind.limits.of_channels(len(stand.driver.channels))
        assert stand.driver.channels == stand.section.channels
        for of_reading, of_range in (kind.accuracy[range_v] for range_v in limits.ranges_v):
            assert 0.0 < of_reading < 1e-2
            assert 0.0 < of_range < 1e-2
        assert limits.nplc == tuple(sorted(limits.nplc))
        assert stand.section.facts.OVER_RANGE >= 1.0


@voltmeters
def test_it_reads_volts_of_its_signals(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        settings = stand.settings()
        stand.driver.configure(settings)
        for angle_rad in (0.0, 2.0):
            stand.world.turn(angle_rad, 1)
            samples = reading(stand)
            assert tuple(samples) == stand.driver.channels
            for channel, values in samples.items():
                assert len(values) == settings.samples
                truth_v = stand.world.signal_v(channel)
                assert np.array(values) == pytest.approx(truth_v, abs=1e-3)  # ΔU_M: 0.3 mV a reading
                assert abs(truth_v) > 1e-2


@voltmeters
@pytest.mark.parametrize("wrong", [{"range_v": 7.7}, {"nplc": 0.33}, {"samples": 10**9}, {"samples": 0}])
def test_what_it_cannot_do_is_refused_before_anything_is_sent(device, tmp_path, wrong):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        stand.sent.clear()
        with pytest.raises(LimitExceeded):
            stand.driver.configure(stand.settings(**wrong))
        assert stand.sent == []


@voltmeters
def test_a_setting_that_was_not_taken_is_noticed(device, tmp_path):
    with standing(device, tmp_path) as stand:
        wanted = stand.settings().samples
        stand.driver.open()
        stand.driver.configure(stand.settings())
        sent = stand.sent
    with standing(device, tmp_path, taking(str(wanted), str(wanted + 1))) as stand:
        stand.driver.open()
        if not any(re.search(rf"(?<![\d.]){wanted}(?!\d)", text) for text in sent):
            skip_if_own(device, "its number of samples is not sent")
        with pytest.raises(InstrumentRefused) as refusal:
            stand.driver.configure(stand.settings())
        assert str(wanted) in refusal.value.cause


@voltmeters
def test_nothing_is_read_that_was_not_configured_or_started(device, tmp_path):
    with standing(device, tmp_path) as stand:
        stand.driver.open()
        with pytest.raises(BenchError):
            stand.driver.start()
        stand.driver.configure(stand.settings())
        with pytest.raises(BadReading):
            stand.driver.fetch()


@voltmeters
def test_an_overload_is_no_reading(device, tmp_path):
    with standing(device, tmp_path) as stand:
        if not hasattr(stand.dialect, "overloaded"):
            pytest.skip("its simulation cannot be overloaded")
        stand.driver.open()
        stand.driver.configure(stand.settings())
        stand.dialect._dialect.overloaded = True
        with pytest.raises(BadReading, match="overload"):
            reading(stand)


@pytest.mark.slow
@voltmeters
def test_a_meter_that_was_switched_off_is_told_and_set_anew(device, tmp_path):
    with standing(device, tmp_path) as stand:
        limits = stand.driver.limits
        quick = stand.settings(nplc=limits.nplc[0], samples=max(1, limits.least_samples))  # it is waited for
        stand.driver.open()
        stand.driver.configure(quick)
        before = reading(stand)
        stand.dialect.power_cycle()
        with stand.expecting_nothing(), pytest.raises((InstrumentLost, InstrumentRefused, BadReading)):
            reading(stand)
        stand.driver.open()
        stand.driver.configure(quick)
        after = reading(stand)
        for channel, values in before.items():
            assert np.mean(after[channel]) == pytest.approx(np.mean(values), abs=1e-3)


@voltmeters
def test_a_cut_reading_is_none(device, tmp_path):
    with standing(device, tmp_path, Cutting, timeout="60 s") as stand:
        stand.driver.open()
        stand.driver.configure(stand.settings())
        stand.driver.start()
        stand.dialect.cut = True
        with pytest.raises((BadReading, InstrumentLost)):
            stand.driver.fetch()
