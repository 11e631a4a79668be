"""Bench files in a form: who may, which names, nobody's change lost, instruments found."""

import re
from html import unescape
from pathlib import Path
from urllib.parse import quote

import pytest

from bench.base.yaml_files import read_yaml
from bench.config.bench_file.file import load_bench
from bench.config.shipped import CONFIG
from bench.panel.access import Role
from bench.panel.bench_fields import GRAVITY_FORM, values_of
from bench.panel.own_files import own_files
from bench.panel.searching import IDENTIFY, OFFERS, Findings, Search, carried_out
from bench.services.search import FoundResource
from drivers.wire.resources import Offer, SerialPort
from tests.panel.test_bench_fields import SHIPPED, comments
from tests.support.panel_client import OWN, Browser, stranger

LAN = "TCPIP0::192.0.2.99::5025::SOCKET"


def hashed(page):
    return re.search(r'name="sha256" value="([0-9a-f]*)"', page)[1]


def new(anna, name="mine", start="bench-lan", **typed):
    return anna.post("/bench/form", file="", start=start, new_name=name, sha256="", do="write", **typed)


# --- pages ------------------------------------------------------------------------------------------


def test_operators_and_supervisors_alone_may_see_and_write(runs, anna):
    assert stranger(runs).get("/bench").status_code == 303
    eve = Browser(runs, "eve", Role.VIEWER)
    assert [
        eve.get(path).status_code for path in ("/bench", "/bench/form?start=bench-lan", "/bench/search")
    ] == [403] * 3
    assert new(eve).status_code == 403
    assert eve.post("/bench/test", file="mine").status_code == 403
    assert "/bench" not in eve.get("/").text
    reply = anna.client.post(
        "/bench/form", data={"start": "bench-lan", "new_name": "mine", "do": "write"}, headers=OWN
    )
    assert reply.status_code == 403
    assert list(Path().iterdir()) == []
    assert new(Browser(runs, "cora", Role.SUPERVISOR)).status_code == 303


def test_a_new_bench_is_written_with_what_was_typed_and_is_listed(anna):
    assert "bench-lan" in anna.get("/bench").text
    page = anna.get("/bench/form?start=bench-lan&name=mine").text
    assert '<input id="name" name="name" value="mine"' in page
    reply = new(anna, name="mine", **{"instruments.voltmeters[1].resource": LAN})
    assert reply.headers["location"] == "/bench/form?file=mine&written=1&example=bench-lan"
    text = Path("config/mine.yaml").read_text("utf-8")
    assert text.startswith("# changed in the panel by anna on 20")
    assert set(comments(SHIPPED["bench-lan"].read_text("utf-8"))) <= set(comments(text))
    assert load_bench(Path("config/mine.yaml")).instruments.voltmeters[0].resource == LAN
    assert "config/mine.yaml" in anna.get("/bench").text
    assert "What is written" in anna.get(reply.headers["location"]).text


def still(page):
    """The fields marked as still the example's, after a check that the line at the top counts them."""
    names = re.findall(r'id="h-([^"]+)">[^<]*<b class="still">still the example.s value</b>', unescape(page))
    counted = re.search(r"still have the value of the example bench-lan: (\d+)\.", page)
    assert int(counted[1] if counted else 0) == len(names)
    return set(names)


def test_what_is_still_the_value_of_the_example_is_marked_until_it_is_changed(runs, anna):
    page = anna.get("/bench/form?start=bench-lan&name=mine").text
    assert "✓ no mistake" in page  # it is a note, no mistake
    example = values_of(read_yaml(SHIPPED["bench-lan"].read_text("utf-8")).data)
    block = {name for name in example if name.startswith("unit_under_test.") and ".supply." not in name}
    of_lab = block | {f"instruments.voltmeters[{n}].resource" for n in (1, 2, 3)}
    of_lab |= {"gravity.latitude", "gravity.height"}
    of_lab |= {name for name in example if name.startswith("stand.") and name.endswith(".limit")}
    assert still(page) == of_lab
    typed = {
        "unit_under_test.serial": "17-042",
        "gravity.latitude": "51 deg",
        "stand.axis_tilt.limit": "6 arcsec",
    }
    search = Search(runs / ".panel" / "search")
    search.path.mkdir(parents=True)
    found = example["instruments.voltmeters[2].resource"]
    search.tell(Findings(IDENTIFY, resources=[FoundResource(found).to_json()]))
    chosen = {"instruments.voltmeters[2].resource"}  # an address that was found is the bench's own
    reply = new(anna, **typed)
    page = anna.get(reply.headers["location"]).text
    assert still(page) == of_lab - set(typed) - chosen
    again = anna.post("/bench/form", file="mine", example="bench-lan", sha256=hashed(page), do="show",
                      **{GRAVITY_FORM: "value of gravity", "gravity": "9.81 m/s^2"}).text  # fmt: skip
    assert still(again) == of_lab - set(typed) - chosen - {"gravity.height"}
    assert still(anna.get("/bench/form?file=mine").text) == set()  # nobody knows where the file came from
    assert anna.get("/bench/form?file=mine&example=../mine").status_code == 404


@pytest.mark.parametrize(
    "name", ["", "../x", "a/b", ".x", "x.yaml", "a b", "bench-lan", "x" * 61, "a\\b", "-x"]
)
def test_names_that_are_none_or_taken_are_refused_at_the_field(runs, name):
    reply = new(Browser(runs, "anna"), name=name)
    assert reply.status_code == 200
    assert 'id="m-new_name-1"' in reply.text
    assert list(Path().iterdir()) == []


def test_nothing_is_read_or_written_outside_the_working_folder(anna, tmp_path):
    outside = tmp_path / "outside.yaml"
    outside.write_text(SHIPPED["bench-lan"].read_text("utf-8"))
    Path("linked.yaml").symlink_to(outside)
    assert own_files(CONFIG) == {}
    for file in ("linked.yaml", "../outside.yaml", "bench-lan", "/etc/passwd", "none"):
        assert anna.get("/bench/form", params={"file": file}).status_code == 404
        assert anna.post("/bench/form", file=file, do="write", sha256="").status_code == 404
        assert anna.post("/bench/test", file=file).status_code == 404
    (tmp_path / "elsewhere").mkdir()
    Path("config").symlink_to(tmp_path / "elsewhere")
    assert "is a symbolic link out of the working folder" in unescape(new(anna).text)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_mistakes_are_all_told_and_what_is_typed_survives(runs):
    reply = new(Browser(runs, "anna"), **{"line_frequency": "55 Hz", "unit_under_test.scale_factors.x": "<b>2",
                                          "unit_under_test.serial": "17-042"})  # fmt: skip
    text = reply.text
    assert "Not written: 2 mistakes" in text
    assert 'id="m-line_frequency-1"' in text
    assert 'id="m-unit_under_test.scale_factors.x-1"' in text
    assert 'value="&lt;b&gt;2"' in text
    assert 'value="17-042"' in text
    assert not Path("config").exists()


def test_control_characters_are_refused(runs):
    for text in ("a\nb", "\x1b[2J", "\u202e"):
        assert new(Browser(runs, f"anna{ord(text[0])}"), description=text).status_code == 400


def test_a_file_changed_meanwhile_is_not_written_over_until_the_difference_was_shown(anna):
    new(anna)
    shown = hashed(anna.get("/bench/form?file=mine").text)
    path = Path("config/mine.yaml")
    path.write_text(path.read_text("utf-8").replace("line_frequency: 50 Hz", "line_frequency: 60 Hz"))
    theirs = path.read_bytes()
    typed = {"file": "mine", "line_frequency": "50 Hz", "description": "other", "do": "write"}
    reply = anna.post("/bench/form", sha256=shown, **typed)
    assert path.read_bytes() == theirs
    assert "the file changed since" in reply.text
    assert "-line_frequency: 60 Hz\n+line_frequency: 50 Hz" in reply.text
    assert anna.post("/bench/form", sha256=hashed(reply.text), **typed).status_code == 303
    assert load_bench(path).description == "other"


def test_a_file_of_a_hand_keeps_its_ends_of_lines_and_what_the_form_does_not_know(anna):
    text = SHIPPED["bench-lan"].read_text("utf-8") + '\ncheck_block: {serial: "7"}   # ours\n'
    Path("mine.yaml").write_bytes(text.replace("\n", "\r\n").encode())
    sha = hashed(anna.get("/bench/form?file=mine.yaml").text)
    assert (
        anna.post("/bench/form", file="mine.yaml", sha256=sha, do="write", description="d").status_code == 303
    )
    content = Path("mine.yaml").read_bytes()
    assert b'check_block: {serial: "7"}   # ours\r\n' in content
    assert content.count(b"\n") == content.count(b"\r\n")


def test_a_file_that_is_no_yaml_is_told_so(anna):
    Path("bad.yaml").write_text("instruments: [\n")
    assert "1 mistake" in anna.get("/bench").text
    reply = anna.get("/bench/form?file=bad.yaml")
    assert (reply.status_code, "not YAML" in reply.text) == (409, True)
    Path("odd.yaml").write_text("instruments:\n  - a\n")
    assert anna.get("/bench/form?file=odd.yaml").status_code in {200, 409}


# --- the search -------------------------------------------------------------------------------------


@pytest.fixture
def started(monkeypatch):
    """What was started instead of processes."""
    calls = []
    monkeypatch.setattr("bench.panel.searching.start", lambda *given, **more: calls.append((given, more)))
    return calls


def test_finding_addresses_nothing_and_what_is_found_is_given_to_an_instrument(
    runs, anna, started, monkeypatch
):
    offer = Offer((LAN,), (SerialPort("ASRL/dev/ttyS0::INSTR", "/dev/ttyS0", ""),), ("USB was not searched",))
    monkeypatch.setattr("bench.services.search.discover", lambda: offer)
    monkeypatch.setattr("bench.services.search.MessageSession", None)
    form = {"file": "", "start": "bench-gpib", "new_name": "mine", "sha256": "", "description": "kept"}
    page = anna.post("/bench/form", do=OFFERS, **form).text
    assert "data-searching" in page
    assert 'value="kept"' in page
    assert len(started) == 1
    search = Search(runs / ".panel" / "search")
    search.tell(carried_out(search.found()))
    page = anna.post("/bench/form", do="show", **form).text
    assert "USB was not searched" in page
    assert f'id="ask:0" name="ask:0" value="yes" checked> <label for="ask:0" class="name">{LAN}' in page
    assert 'id="ask:1" name="ask:1" value="yes"> ' in page  # a serial port is addressed on demand alone
    reply = anna.post("/bench/form", do="write", **form, **{"resource:0": LAN, "is:0": "y",
                      "instruments.voltmeters[2].interface": "lan"})  # fmt: skip
    assert reply.status_code == 303
    assert [m.resource for m in load_bench(Path("config/mine.yaml")).instruments.voltmeters][1] == LAN


def test_a_file_that_is_not_yaml_says_where_and_leads_back(anna):
    Path("config").mkdir()
    Path("config/bad.yaml").write_text("name: bad\ninstruments: [\n  x: : y\n")
    page = unescape(anna.get("/bench/form?file=bad").text)
    assert re.search(r"config/bad.yaml, line 3: this is not YAML: .*; correct it in an editor", page)
    assert "<h1>This is not possible</h1>" in page
    assert 'href="/bench">Back' in page


def test_a_name_that_cannot_be_written_is_a_mistake_before_it_is_written(anna):
    for name, says in (
        ("hall 3!", "letters, digits"),
        ("bench-gpib", "there is a bench file bench-gpib already"),
    ):
        page = anna.get(f"/bench/form?start=bench-lan&name={quote(name)}").text
        assert "✗ 1 mistake<" in page
        assert says in page
    assert "✓ no mistake" in anna.get("/bench/form?start=bench-lan").text  # there is no name yet


def test_an_identified_meter_brings_its_driver(runs, anna):
    search = Search(runs / ".panel" / "search")
    search.path.mkdir(parents=True)
    told = FoundResource(
        LAN, identity="K 34461A", serial="1", driver="keysight-34461a", interface="lan", shows="+1 V"
    )
    search.tell(Findings(IDENTIFY, resources=[told.to_json()]))
    page = anna.post(
        "/bench/form", file="", start="bench-gpib", sha256="", do="show", **{"resource:0": LAN, "is:0": "z"}
    ).text
    assert re.search(
        r'name="instruments.voltmeters\[3\].driver".*?<option value="keysight-34461a" selected>',
        page,
        re.DOTALL,
    )
    assert re.search(
        r'name="instruments.voltmeters\[3\].interface".*?<option value="lan" selected>', page, re.DOTALL
    )
    assert "K 34461A, shows +1 V" in page


def shown_as(page):
    """What each resource found is shown to be, and the resource of each voltmeter."""
    chosen = re.findall(r'name="was:\d" value="(\w*)"', page)
    selected = [
        re.findall(r'<option value="(\w+)" selected', one) for one in re.findall(r'id="is:\d".*', page)
    ]
    assert selected == [[one] if one else [] for one in chosen]
    meters = [rf'id="instruments.voltmeters\[{n}\].resource"[^>]*? value="([^"]*)"' for n in (1, 2, 3)]
    return chosen, [re.search(meter, page)[1] for meter in meters]


def test_the_form_shows_what_each_resource_is_and_refuses_two_of_a_kind(runs, anna):
    found = [f"TCPIP0::192.0.2.{n}::5025::SOCKET" for n in (41, 42, 43)]
    search = Search(runs / ".panel" / "search")
    search.path.mkdir(parents=True)
    search.tell(Findings(IDENTIFY, resources=[FoundResource(one).to_json() for one in found]))
    own = {f"resource:{number}": one for number, one in enumerate(found)}

    def sent(now, before=("", "", ""), typed=("", "", "")):
        names = {f"instruments.voltmeters[{n}].resource": text for n, text in enumerate(typed, 1)}
        rows = {f"{key}:{n}": one for key, two in (("is", now), ("was", before)) for n, one in enumerate(two)}
        form = {"file": "", "start": "bench-lan", "new_name": "mine", "sha256": "", "do": "show"}
        return anna.post("/bench/form", **form, **own, **rows, **names).text

    assert shown_as(sent("xyz")) == (["x", "y", "z"], found)
    assert shown_as(sent("yxz", "xyz", found)) == (["y", "x", "z"], [found[1], found[0], found[2]])
    by_hand = [LAN, *found[1:]]  # what is typed holds where the choice is as it was
    assert shown_as(sent("xyz", "xyz", by_hand)) == (["", "y", "z"], by_hand)
    assert shown_as(sent("xyy", "xyz", found)) == (["x", "", "y"], [found[0], found[2], ""])
    twice = sent("xxz", typed=found)
    assert "Two of the instruments found are chosen as x" in twice
    assert shown_as(twice)[0] == ["", "", "z"]


@pytest.mark.parametrize(
    "typed", ["rm -rf", "$(id)", "TCPIP0", "\n".join(f"GPIB0::{number}::INSTR" for number in range(31))]
)
def test_what_is_no_resource_is_not_addressed(runs, started, typed):
    page = (
        Browser(runs, "anna")
        .post("/bench/form", file="", start="bench-lan", sha256="", do=IDENTIFY, further=typed)
        .text
    )
    assert started == []
    assert "note bad" in page
    assert typed.splitlines()[0] in unescape(page)


def test_a_resource_that_does_not_answer_is_one_with_its_failure(runs):
    told = carried_out(Findings(IDENTIFY, done=False, order=["TCPIP0::127.0.0.1::1::SOCKET"]))
    assert told.done
    assert told.resources[0]["failure"].startswith("TCPIP0::127.0.0.1::1::SOCKET refused the connection")


def test_the_results_of_a_test_stand_at_the_instruments(runs, anna, started):
    new(anna)
    assert anna.post("/bench/test", file="mine").status_code == 303
    search = Search(runs / ".panel" / "search")
    assert anna.post("/bench/test", file="mine").status_code == 409  # one at a time
    assert "are being tested" in anna.get("/bench/form?file=mine").text
    row = {
        "name": "voltmeter.x",
        "identity": "K",
        "self_test": "passed",
        "shows": "x +1 V",
        "failures": ["no wire"],
    }
    search.tell(Findings("test", bench=search.found().bench, instruments=[row]))
    page = anna.get("/bench/form?file=mine").text
    assert page.count("x +1 V") == 2
    assert page.count("no wire") == 2
