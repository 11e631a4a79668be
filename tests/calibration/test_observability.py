"""Ranks and null vectors: the table of the paper's bench, and against its own geometry of the tests."""

from functools import partial

import numpy as np
import pytest

from bench.calibration.design import make_problem
from bench.calibration.observability import (
    Direction,
    DirectionKind,
    Sensitivities,
    axis_in_words,
    columns_of,
    observability,
    with_angles,
)
from bench.model import AppliedEffect, Block, Conditions, Effect, ForwardModel, Installation, Parameter, Stage
from bench.model.geometry import COEFFICIENTS, INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import ARCSEC, TRUTH, U0, K, design, specific_force

A1, A2, A3, A5 = "axis_tilt", "zero_offset", "mounting_error", "mounting_roll"
BLOCK = Block(K, U0)
MODEL = ForwardModel(
    {
        "1": INSTALLATION_1,
        "2": INSTALLATION_2,
        "3": Installation.from_axes("3", ("y", "z", "x")),
        "1T180": Installation.from_axes("1T180", ("-x", "-y", "z")),
        "V45": Installation.from_axes("V45", ("x", "y", "z"), np.radians(45)),
        "V0": Installation.from_axes("V0", ("x", "y", "z")),
    }
)


def paper(model=MODEL, passes=1, points=9, step_deg=45.0, installations="12"):
    rows = [(i, p, t) for i in installations for p in range(1, passes + 1) for t in range(1, points + 1)]
    label, number, point = (list(column) for column in zip(*rows, strict=True))
    angle = np.radians(step_deg) * (np.array(point) - 1)
    return make_problem(model, Conditions.of(label, angle, pass_number=number, point=point), {})


def verification(label):
    return Conditions.of([label] * 4, np.radians([45.0, 135.0, 225.0, 315.0]))


TABLE = [
    # stand angles, further unknowns and rows, rank, columns
    ((), {}, 12, 12),
    ((A1,), {}, 14, 14),
    ((A2,), {}, 14, 14),
    ((A3,), {}, 14, 14),
    ((A1, A2, A3), {}, 16, 18),
    ((A1, A2, A3, A5), {}, 16, 20),
    ((A1, A2, A3, A5), {"modulus": "V45"}, 17, 20),
    ((A1, A2, A3, A5), {"modulus": "V0"}, 16, 20),
]


@pytest.mark.parametrize(("angles", "further", "rank", "columns"), TABLE)
@pytest.mark.parametrize("passes", [1, 3])
def test_ranks_of_the_papers_bench(angles, further, rank, columns, passes):
    given = dict(further)
    if "modulus" in given:
        given["modulus"] = verification(given["modulus"])
    found = observability(with_angles(paper(passes=passes), angles), BLOCK, **given)
    assert (found.rank, found.columns) == (rank, columns)
    assert len(found.directions) == columns - rank
    assert len(found.determined) + len(found.undetermined) == columns


def test_two_angles_of_one_installation_are_seen():
    problem = with_angles(paper(), (A2, A3))
    one = columns_of(problem, BLOCK).without(("alpha2[2]", "alpha3[2]"))
    assert (one.observability(BLOCK).rank, len(one.names)) == (14, 14)


def signals(change, psi=None, modulus=False):
    """The tests' own simulation: the 18 readings with the unknowns changed, or |a| at the verification points."""
    block = TRUTH + np.array([change.get(name, 0.0) for name in COEFFICIENTS])
    matrix, bias = block[:9].reshape(3, 3), block[9:]
    installation, _, _, phi = design(passes=1)
    if modulus:
        installation, phi = ["1"] * 4, np.radians([45.0, 135.0, 225.0, 315.0])
        measured = specific_force(installation, phi, psi=psi) @ K.T + U0
        return np.linalg.norm(np.linalg.solve(matrix, (measured - bias).T), axis=0)
    angles = {
        f"alpha{i}": np.array([change.get(f"alpha{i}[{m}]", 0.0) for m in installation]) for i in (1, 2, 3, 5)
    }
    return specific_force(installation, phi, **angles) @ matrix.T + bias


def test_directions_leave_no_trace_in_another_simulation():
    """30 arcsec along each direction change no signal but by the square of it; along other unknowns they do."""
    problem = with_angles(paper(), (A1, A2, A3, A5))
    step = 30 * ARCSEC
    found = observability(problem, BLOCK)
    for direction in found.directions:
        change = {name: size * step for name, size in direction.members.items()}
        assert np.max(np.abs(signals(change) - signals({}))) < 10 * step**2
        largest = max(direction.members, key=lambda name: abs(direction.members[name]))
        assert np.max(np.abs(signals({largest: change[largest]}) - signals({}))) > 0.9 * step


def test_a_turn_of_the_block_keeps_the_modulus_and_the_third_mounting_angle_does_not():
    found = observability(with_angles(paper(), (A1, A2, A3, A5)), BLOCK).directions
    turns = [d for d in found if d.kind is DirectionKind.TURN]
    (roll,) = [d for d in found if d.kind is not DirectionKind.TURN]
    step = 30 * ARCSEC
    modulus = partial(signals, modulus=True)
    for psi in (0.0, np.radians(45), np.radians(20)):
        for direction in turns:
            changed = modulus({n: s * step for n, s in direction.members.items()}, psi)
            assert np.max(np.abs(changed - 1)) < 10 * step**2
    changed = {n: s * step for n, s in roll.members.items()}
    assert np.max(np.abs(modulus(changed, 0.0) - 1)) < 10 * step**2
    # two angles of 90 arcsec put 309 ug into the modulus where the block is turned by 45 deg about z
    by_90 = 3 * np.max(np.abs(modulus(changed, np.radians(45)) - 1))
    assert by_90 == pytest.approx(309e-6, rel=0.01)


def test_a_direction_is_told_in_words():
    found = observability(with_angles(paper(), (A1, A2, A3, A5)), BLOCK)
    x, y, z, roll = found.directions
    assert [axis_in_words(d.axis) for d in (x, y, z)] == ["x", "y", "z"]
    assert y.text() == (
        "a common turn of the block's axes about y (of alpha2[1] and alpha3[2] only the sum is shown): "
        "1 arcsec is -10.4 µV/g in Kzx, +10.6 µV/g in Kxz"
    )
    assert set(x.others) == set(roll.others) == {"alpha5[1]", "alpha5[2]"}
    assert "only the sum" not in x.text()  # the sum is open, too
    assert roll.kind is DirectionKind.MIXED
    assert roll.text().startswith(
        "a change of alpha5[1], alpha5[2] in the ratio 1 : 1 is indistinguishable from a change of "
        "coefficients: 1 arc"
    )
    # by alpha5 in installation 1, K_yz takes -K_yy of it
    assert roll.members["Kyz"] / roll.members["alpha5[1]"] == pytest.approx(2.14, rel=0.005)
    assert {"alpha1[1]", "alpha1[2]", "Kxx", "U0y"} <= set(found.determined)
    assert {"Kyz", "Kzy", "alpha2[1]"} <= set(found.undetermined)


def test_an_oblique_turn_and_signals_in_another_unit():
    """Where alpha2 and alpha3 are the same in both installations, one turn about y and z together is left."""
    apart = columns_of(with_angles(paper(), (A2, A3)), BLOCK)
    angles = [name for name in apart.names if name.startswith("alpha")]
    shared = np.stack(
        [apart.of(f"{symbol}[1]") + apart.of(f"{symbol}[2]") for symbol in ("alpha2", "alpha3")]
    )
    rest = apart.without(angles)
    both = Sensitivities(np.column_stack([rest.rows, shared.T]), (*rest.names, "alpha2[all]", "alpha3[all]"))
    (turn,) = both.observability(BLOCK).directions
    assert turn.kind is DirectionKind.TURN
    assert "about the axis 0.71 y +0.71 z" in turn.text()
    assert "counts/g in" in turn.text("counts")


def test_unknowns_that_act_alike_and_not_at_all():
    (first, second) = observability(with_angles(paper(), (A2, "mounting_offset")), BLOCK).directions
    assert first.kind is second.kind is DirectionKind.ALIKE
    assert first.text() == (
        "of alpha2[1] and mounting_offset[1] only the sum is shown; the readings cannot tell them apart"
    )
    one = observability(paper(installations="1"), BLOCK)
    assert one.rank == 9
    assert [d.text() for d in one.directions] == [f"K{i}y: no reading depends on it" for i in "xyz"]


def test_of_free_positions_alone_the_axes_are_a_convention():
    """Six or more moduli determine all but a turn of the axes: 9 of 12."""
    angles = np.radians(np.arange(0.0, 360.0, 30.0))
    labels = ["1"] * 12 + ["2"] * 12 + ["3"] * 12 + ["V45"] * 12
    nothing = make_problem(MODEL, Conditions.of([], []), {})
    found = observability(nothing, BLOCK, modulus=Conditions.of(labels, np.tile(angles, 4)))
    assert found.rank == 9
    assert [d.kind for d in found.directions] == [DirectionKind.TURN] * 3
    assert found.directions[0].text().startswith("a common turn of the block's axes about x: 1 arcsec is ")


def test_a_remount_by_180_deg_shows_neither_turn_nor_roll_and_a_third_installation_the_roll():
    angles = (A1, A2, A3, A5)
    half = observability(with_angles(paper(installations=("1", "2", "1T180")), angles), BLOCK)
    third = observability(with_angles(paper(installations=("1", "2", "3")), angles), BLOCK)
    assert (half.rank, half.columns) == (20, 24)
    assert (third.rank, third.columns) == (21, 24)
    assert {d.kind for d in third.directions} == {DirectionKind.TURN}


def test_what_is_determined_and_what_is_not_is_everything():
    found = observability(with_angles(paper(), (A1, A2, A3)), BLOCK)
    assert (found.rank, found.columns) == (16, 18)
    assert {d.kind for d in found.directions} == {DirectionKind.TURN}
    assert dict(found.directions[0].members)["alpha2[1]"] == pytest.approx(1.0, rel=1e-6)
    assert sorted(found.determined + found.undetermined) == sorted(
        [*COEFFICIENTS, *(f"alpha{i}[{m}]" for i in (1, 2, 3) for m in "12")]
    )


# --- terms that are not linear -----------------------------------------------------------------------


class Terms(Effect):
    """Further terms of the output, each a power product of the specific force with a parameter per channel."""

    name = "terms"
    stage = Stage.BLOCK_OUTPUT
    sentence = shown_by = ""
    subsystem = "block"
    per_mount = False

    def __init__(self, forms):
        self.forms = forms
        self.parameters = tuple(Parameter(name, "1", 1.0, 1e-5, per_channel=True) for name in forms)

    def addition(self, values, seen):
        return sum(
            seen.scale * values[n][:3] * np.stack([form(seen.signal, i) for i in range(3)], axis=1)
            for n, form in self.forms.items()
        )


def own(power):
    return lambda a, i: a[:, i] ** power


def product(j, k):
    return lambda a, i: a[:, j] * a[:, k]


def odd_square(a, i):
    return a[:, i] * np.abs(a[:, i])


QUADRATICS = {f"a{'xyz'[j]}a{'xyz'[k]}": product(j, k) for j in range(3) for k in range(j, 3)}
CUBIC = {"K2": own(2), "K3": own(3)}


def rank_of_a_channel(forms, channel, step_deg=45.0):
    """Rank and columns of one channel: three scale factors, a bias, and the terms."""
    model = ForwardModel(MODEL.installations, (AppliedEffect(Terms(forms), {}, (channel,)),))
    points = round(360 / step_deg) + 1
    found = observability(paper(model, points=points, step_deg=step_deg), BLOCK)
    return found.rank - 8, found.columns - 8


@pytest.mark.parametrize("channel", "xyz")
def test_ranks_with_terms_of_higher_order(channel):
    assert rank_of_a_channel({}, channel) == (4, 4)
    assert rank_of_a_channel(QUADRATICS, channel) == (8, 10)
    assert rank_of_a_channel(CUBIC, channel) == (6, 6)
    assert rank_of_a_channel(CUBIC | {"Koq": odd_square}, channel) == (6, 7)
    for points in (12, 16, 24, 36):
        assert rank_of_a_channel(CUBIC | {"Koq": odd_square}, channel, 360 / points) == (7, 7)


def test_the_cubic_and_the_odd_square_are_told_as_inseparable():
    model = ForwardModel(
        MODEL.installations, (AppliedEffect(Terms(CUBIC | {"Koq": odd_square}), {}, ("y",)),)
    )
    (direction,) = observability(paper(model), BLOCK).directions
    assert isinstance(direction, Direction)
    assert set(direction.others) == {"terms.K3[y]", "terms.Koq[y]"}
    assert direction.coefficients == ["Kyy"]
    assert "is indistinguishable from a change of coefficients: 1 of terms." in direction.text()


def test_a_bias_changes_in_the_unit_of_the_signals_and_a_factor_per_g():
    mixed = Direction(DirectionKind.MIXED, {"thermal_emf.E[x]": 1.0, "U0x": 2e-6, "Kxx": -3e-6})
    assert mixed.text("V").endswith("1 of thermal_emf.E[x] (SI) is +2 µV in U0x, -3 µV/g in Kxx")
    assert mixed.text("counts").endswith("is +2e-06 counts in U0x, -3e-06 counts/g in Kxx")
