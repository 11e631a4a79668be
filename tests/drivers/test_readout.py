"""A head that a person turns and an encoder reads: its track, its person, its alarms; without any counter."""

import math

import pytest

from drivers.interfaces import BadReading, HeadPosition, Identity, InstrumentRefused, LimitExceeded
from drivers.person import ATTEMPTS, Answer, PromptKind
from drivers.readout import MOST_ATTEMPTS, Approach, ReadOutHead, ScaleOfEncoder, Track
from tests.support.scripted_session import Clock, ScriptedSession

DEG = math.pi / 180
SEC = DEG / 3600
APPROACH = Approach(30 * SEC, 1 * DEG, 2 * SEC, 2.0, 90 * DEG)
FREE = Approach(30 * SEC, 1 * DEG, 2 * SEC, 2.0, 90 * DEG, hands_free=True)
TYPED = Approach(30 * SEC, 1 * DEG, 2 * SEC, 2.0, 90 * DEG, typed=True)


def track(*degrees, target=45.0, direction=1, every_s=0.5):
    made = Track(APPROACH, target * DEG, direction)
    for number, angle in enumerate(degrees):
        assert made.take(number * every_s, angle * DEG) is None
    return made


STILL = [45.0] * 5


@pytest.mark.parametrize(
    ("way", "direction", "problem"),
    [
        ([20, 40, 43, 44.9, *STILL], 1, ""),
        ([80, 50, 47, 45.1, *STILL], -1, ""),
        ([80, 50, 47, 45.1, *STILL], 1, "did not approach from below: back off by 1°00′00″"),
        ([20, 40, 43, 44.9, *STILL], -1, "did not approach from above"),
        ([20, 40, 43, 45.1, *STILL], 1, "did not approach from below"),  # beyond it, and back
        ([20, 40, 43, 45.1, 44.5, *STILL], 1, "did not approach from below"),  # not far enough back
        ([20, 40, 43, 45.1, 43.9, *STILL], 1, ""),
        ([44.5, 44.9, *STILL], 1, "did not approach from below"),  # begun too near
        ([*STILL], 1, "did not approach from below"),
        ([20, 44.9, 45, 45, 45], 1, "still moves"),
        ([20, 44.9, *[45.0, 45.001] * 3], 1, "still moves, by 0°00′03.6″ within 2 s"),
        ([20, 44.9, *[45.01] * 5], 1, r"shows 45°00′36″, 0°00′36.0″ above the target, outside the 0°00′30″"),
        ([20, 44.0, *[44.99] * 5], 1, "below the target"),
    ],
)
def test_what_a_way_to_45_degrees_is_worth(way, direction, problem):
    said = track(*way, direction=direction).problem
    assert bool(said) == bool(problem)
    assert problem.replace("\\", "") in said


def test_the_angle_is_on_the_turn_of_the_target():
    assert track(350, 359, 0.001, 0.001, target=360.0).angle_rad == pytest.approx(360.001 * DEG)
    assert track(10, 2, 359.999, target=0.0, direction=-1).angle_rad == pytest.approx(-0.001 * DEG)


def test_half_a_turn_away_is_before_the_target_once_it_moves():
    way = [0, 60, 120, 170, 179.99, *[180.0] * 5]
    assert track(*way, target=180.0, every_s=0.8).problem == ""


def test_a_hand_turns_no_faster_than_is_stated():
    made = track(10.0, 20.0)
    assert made.take(1.5, 120.0 * DEG) == pytest.approx(100 * DEG)
    assert made.take(1.5, 100.0 * DEG) is None  # 80° in 1 s


@pytest.mark.parametrize(("falling", "angle"), [(False, 35.0), (True, -35.0)])
def test_zero_and_sense_of_an_encoder(falling, angle):
    assert ScaleOfEncoder(10 * DEG, falling).angle_rad(45 * DEG) == pytest.approx(angle * DEG)


# --- the head ---------------------------------------------------------------------------------------


class Encoder(ReadOutHead):
    """A head over what the encoder shows in turn; the last angle stays."""

    def __init__(self, person, approach, clock, *, tells_reference=True):
        self.degrees, self.proofs = [0.0], 0
        session = ScriptedSession(clock=clock)
        super().__init__(
            "head", session, clock, person, approach, scale=ScaleOfEncoder(), identity=Identity("maker", "counter"),
            tells_reference=tells_reference,
        )  # type: ignore[arg-type]  # fmt: skip

    def _prove(self):
        self.proofs += 1

    def _shown_rad(self):
        return (self.degrees.pop(0) if len(self.degrees) > 1 else self.degrees[0]) * DEG


class Hand:
    """A person who can be watched with: turns the head as the script of each question has it, then answers."""

    def __init__(self, clock, *ways):
        self.clock, self.ways = clock, list(ways)
        self.meanwhile, self.slice_s = None, 1.0
        self.prompts, self.head = [], None

    def ask(self, prompt):
        self.prompts.append(prompt)
        degrees, answer = self.ways.pop(0)
        self.head.degrees = [*degrees]
        while self.meanwhile is not None and self.head.degrees:
            last = len(self.head.degrees) == 1
            self.clock.sleep(self.slice_s)
            self.meanwhile()
            if last:
                break
        return Answer(prompt.id, answer)


def turned(approach, *ways, **kwargs):
    clock = Clock()
    person = Hand(clock, *ways)
    person.head = Encoder(person, approach, clock, **kwargs)
    person.head.open()
    return person.head, person


COMING = [i * 1.5 for i in range(30)] + [44.9, 45.001]
RESTING = [45.001] * 12


def test_hands_free_it_answers_by_itself_once_it_stands():
    head, person = turned(FREE, ([*COMING, *RESTING, *RESTING], "pressed"))
    position = head.move(45 * DEG, 1, "1/turn")
    assert position == HeadPosition(pytest.approx(45.001 * DEG), 1)
    (prompt,) = person.prompts
    assert prompt.kind is PromptKind.CONFIRM
    assert prompt.text == (
        "Turn the head to 45°00′00″: approach with the angle rising, from below; clamp and let go; the encoder is "
        "read once the head is at rest."
    )
    assert prompt.action["do"] == "turn"
    assert prompt.action["read_by"] == "encoder"
    assert len(person.head.degrees) > 1  # before the last look of the script
    assert (person.meanwhile, person.slice_s) == (None, 1.0)


def test_without_it_the_person_confirms_and_the_angle_is_read_at_rest():
    head, person = turned(APPROACH, ([*COMING], ""))
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)
    assert person.clock.now_s() == pytest.approx(len(COMING) * 0.2 + 2.0, abs=0.5)


def test_who_confirms_too_early_is_asked_again():
    head, person = turned(APPROACH, ([10.0, 20.0], ""), ([*COMING[14:]], "no"), ([45.001], "yes"))
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)
    assert [prompt.id for prompt in person.prompts] == ["1/turn#1", "1/turn#2", "1/turn#3"]
    assert "25°00′00.0″ below the target" in person.prompts[1].text
    assert person.prompts[2].text.startswith("There is no hurry.")


def test_the_wrong_side_is_told_once_and_heard_of_no_more_until_it_backs_off():
    wrong = [i * 1.5 for i in range(32)] + [45.5, *RESTING, *RESTING]
    head, person = turned(
        FREE, (wrong, "pressed"), ([*RESTING, *RESTING, 43.0, *RESTING, *RESTING], "pressed")
    )
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)
    assert len(person.prompts) == 2
    assert person.prompts[1].text.startswith(
        "The head did not approach from below: back off by 1°00′00″ at least"
    )


def test_a_head_that_never_comes_is_given_up():
    head, person = turned(APPROACH, *[([0.0], "yes")] * MOST_ATTEMPTS)
    with pytest.raises(
        LimitExceeded, match=r"did not come to 45°00′00″ in 20 attempts \(The encoder shows 0°00′00″"
    ):
        head.move(45 * DEG, 1, "1/turn")
    assert person.ways == []


def test_a_jump_ends_the_question_and_the_angle_is_not_trusted_until_somebody_says_so():
    head, person = turned(FREE, ([1.0, 2.0, 200.0], ""), ([0.0], "yes"), ([*COMING, *RESTING, *RESTING], ""))
    with pytest.raises(
        BadReading, match="the encoder's angle jumped by 162°00′00″ to 200°00′00″, faster than 90°/s"
    ):
        head.move(45 * DEG, 1, "1/turn")
    assert person.meanwhile is None
    head.degrees = [0.0]
    head.move(45 * DEG, 1, "1/turn")
    assert person.prompts[1].text.startswith("Turn the head across the encoder's reference mark.")


def test_a_counter_that_does_not_tell_is_asked_about_once_for_a_connection():
    ways = [
        ([0.0], "yes"),
        ([*COMING, *RESTING, *RESTING], ""),
        ([*COMING, *RESTING, *RESTING], ""),
        ([0.0], "yes"),
    ]
    head, person = turned(FREE, *ways, ([*COMING, *RESTING, *RESTING], ""), tells_reference=False)
    for _ in range(2):
        head.degrees = [0.0]
        head.move(45 * DEG, 1, "1/turn")
    assert [prompt.id for prompt in person.prompts] == ["1/turn/reference#1", "1/turn#1", "1/turn#1"]
    head._session._session.connection = None
    head._session._session.open()
    head.degrees = [0.0]
    head.move(45 * DEG, 1, "2/turn")
    assert person.prompts[3].id == "2/turn/reference#1"


def test_a_connection_made_anew_on_the_way_makes_an_angle_of_none():
    reference = ([0.0], "yes")
    ways = [reference, ([*COMING, *RESTING, *RESTING], ""), reference, ([*COMING, *RESTING, *RESTING], "")]
    head, person = turned(FREE, *ways, tells_reference=False)
    looked, shown = [], head._shown_rad

    def lost_once():
        looked.append(1)
        if len(looked) == 10:
            head._proved()
        return shown()

    head._shown_rad = lost_once
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)
    assert [prompt.id.partition("#")[0] for prompt in person.prompts] == ["1/turn/reference", "1/turn"] * 2


def test_where_nobody_confirms_the_reference_mark_nothing_is_read():
    head, person = turned(FREE, *[([0.0], "no")] * ATTEMPTS, tells_reference=False)
    with pytest.raises(InstrumentRefused, match="nobody confirmed that its reference mark was crossed"):
        head.move(45 * DEG, 1, "1/turn")
    assert len(person.prompts) == ATTEMPTS


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("46 00 03", "You typed 46°00′03″, the encoder shows 45°00′04″: probably the degree line is one off"),
        (
            "45 00 40",
            "You typed 45°00′40″, the encoder shows 45°00′04″: check the encoder's coupling and its zero",
        ),
        ("forty-five", "is not an angle"),
    ],
)
def test_a_typed_angle_is_held_against_the_encoder(typed, said):
    head, person = turned(TYPED, ([*COMING], typed), ([45.001], "45 00 03"))
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)  # the encoder's
    assert person.prompts[0].kind is PromptKind.ANGLE
    assert person.prompts[0].default is None
    assert said in person.prompts[1].text


def test_whoever_cannot_be_watched_with_is_asked_and_the_encoder_read_after_it():
    clock = Clock()

    class Plain:
        def ask(self, prompt):
            head.degrees = [45.001]
            clock.sleep(60.0)
            return Answer(prompt.id, "yes")

    head = Encoder(Plain(), FREE, clock)
    head.open()
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)


def test_where_nothing_can_be_watched_the_side_is_seen_at_the_answers():
    clock, ways, prompts = Clock(), [45.001, 40.0, 45.001], []

    class Plain:
        def ask(self, prompt):
            prompts.append(prompt.text)
            head.degrees = [ways.pop(0)]
            clock.sleep(60.0)
            return Answer(prompt.id, "yes")

    head = Encoder(Plain(), APPROACH, clock)
    head.degrees = [60.0]
    head.open()
    assert head.move(45 * DEG, 1, "1/turn").angle_rad == pytest.approx(45.001 * DEG)
    assert prompts[1].startswith("The head did not approach from below")
    assert "answer at the back-off position, too" in prompts[1]
    assert ways == []


def test_a_stale_answer_confirms_nothing():
    head, person = turned(APPROACH, ([*COMING], "yes"), ([45.001], "yes"))
    ask, stale = person.ask, ["0/turn#1"]
    person.ask = lambda prompt: Answer(stale.pop(), ask(prompt).text) if stale else ask(prompt)
    head.move(45 * DEG, 1, "1/turn")
    assert person.prompts[1].text.startswith("That answer belonged to an earlier question.")
