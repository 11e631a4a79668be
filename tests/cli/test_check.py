"""What `check` tells beside the steps: serial ports, and the dry run to try next."""

import json
from pathlib import Path

import pytest

from tests.support.pages import ROOT

SHIPPED = ROOT / "config" / "bench-rs232.yaml"


@pytest.mark.parametrize("stated", [True, False])
def test_a_serial_port_without_its_interface_is_told(bench, stated):
    text = SHIPPED.read_text(encoding="utf-8")
    assert "      interface: rs232\n" in text
    Path("mine.yaml").write_text(
        text if stated else text.replace("      interface: rs232\n", ""), encoding="utf-8"
    )
    status, out, err = bench("check", "quick", "--bench", "mine.yaml")
    assert (status, err) == (0, "")
    assert out.count("say 'interface: rs232'") == (0 if stated else 3)
    hints = json.loads(bench("check", "quick", "--bench", "mine.yaml", "--json", "-")[1])["hints"]
    assert len(hints) == (0 if stated else 3)


def test_the_dry_run_that_is_offered_has_the_folder_of_devices(bench):
    Path("mine").mkdir()
    offered = bench("check", "quick", "--devices", "mine")[1].splitlines()[-1]
    assert offered.endswith("bench run quick --devices mine --dry-run")
    assert bench("check", "quick")[1].splitlines()[-1].endswith("bench run quick --dry-run")
