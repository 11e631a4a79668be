from bench.model.geometry import Block


def test_half_a_turn_pulls_by_half():
    effect = CablePull()
    half = Seen(np.zeros((1, 5)), conditions_at(np.pi), Block(-2.0 * np.eye(3), np.zeros(3)))
    added = effect.addition({"per_turn": np.array(30 * ARCSEC)}, half)
    expected = np.zeros((1, 5))
    expected[0, 2] = 15 * ARCSEC
    np.testing.assert_allclose(added, expected, atol=1e-15)
