"""The admissible patterns are those that the definitions of the move rules allow, no more and no fewer."""

from functools import cache

import numpy as np
import pytest

import mampc
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.exchanges import PatternNeighbours
from referees import all_patterns, charge, counted, keeps_rules, moved
from seeds import seeds

SEEDS = range(120)


@cache
def random_rules(seed):
    """Rules in random combination for m inputs over nc samples, and past inputs."""
    rng = np.random.default_rng(seed)
    n_c, m = [(4, 2), (3, 3), (7, 1), (5, 2), (4, 1)][seed % 5]
    counting = rng.choice(["elementwise", "simultaneous"])
    price = [0.0, float(rng.uniform(0.1, 2)), tuple(rng.uniform(0, 2, m))][rng.integers(3)]
    if counting == "simultaneous" and np.ndim(price):
        price = 1.0
    rules = mampc.MoveRules(
        max_moves=None if rng.random() < 0.3 else int(rng.integers(0, 6)),
        sparsity_horizon=int(rng.integers(1, 6)),
        price=price,
        counting=str(counting),
        dwell=1 if rng.random() < 0.4 else int(rng.integers(2, 6)),
        max_moves_per_step=None if rng.random() < 0.6 else int(rng.integers(1, m + 2)),
        blocks=None if rng.random() < 0.7 else [(1, 2), (2, 1), (1, 1, 1)][rng.integers(3)],
    )
    changes = rng.standard_normal((rules.memory, m)) * (rng.random((rules.memory, m)) < 0.2)
    changes[rng.random(changes.shape) < 0.2] = 1e-11  # rounding
    return rules, n_c, m, np.cumsum(changes, axis=0)


@cache
def admissible_patterns(seed, *, from_rest=False):
    """The patterns (K, n_moves) that the definitions allow."""
    rules, n_c, m, past = random_rules(seed)
    past = np.repeat(past[-1:], len(past), axis=0) if from_rest else past
    return np.array([p.ravel() for p in all_patterns(n_c, m) if keeps_rules(rules, past, p)])


def as_set(patterns):
    return {pattern.tobytes() for pattern in patterns}


def fitted(seed):
    rules, n_c, m, past = random_rules(seed)
    admissible = AdmissiblePatterns(rules, m, n_c)
    return admissible, admissible.allowance(past)


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_a_pattern_is_allowed_exactly_if_it_keeps_the_rules_by_their_definition(seed):
    _, n_c, m, _ = random_rules(seed)
    admissible, past = fitted(seed)
    allowed = [p.ravel() for p in all_patterns(n_c, m) if admissible.allows(p.ravel(), past)]
    assert as_set(allowed) == as_set(admissible_patterns(seed))


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_the_list_holds_every_pattern_admissible_from_rest_once(seed):
    admissible, _ = fitted(seed)
    expected = admissible_patterns(seed, from_rest=True)
    listed = admissible.listed(len(expected))
    assert len(listed) == len(expected)
    assert as_set(listed) == as_set(expected)
    assert admissible.listed(len(expected) - 1) is None


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_candidates_and_open_moves_are_those_that_some_pattern_may_hold(seed):
    admissible, past = fitted(seed)
    rules, *_ = random_rules(seed)
    if rules.max_moves == 0:
        return  # forbids every move by the budget alone
    np.testing.assert_array_equal(
        admissible.candidates, admissible_patterns(seed, from_rest=True).any(axis=0)
    )
    if past.left:
        np.testing.assert_array_equal(admissible.open(past), admissible_patterns(seed).any(axis=0))


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_count_and_charge_are_those_of_the_definitions(seed):
    rules, n_c, m, _ = random_rules(seed)
    admissible, _ = fitted(seed)
    for pattern in all_patterns(n_c, m):
        assert admissible.count(pattern.ravel()) == counted(pattern, rules.counting)
        assert admissible.charge(pattern.ravel()) == pytest.approx(charge(rules, pattern), rel=1e-14)


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_a_selection_is_admissible_and_best_unless_dwell_times_bind(seed):
    rules, n_c, m, _ = random_rules(seed)
    rng = np.random.default_rng([seed, 1])
    admissible, past = fitted(seed)
    allowed = admissible_patterns(seed)
    for _ in range(5):
        worth = rng.exponential(size=n_c * m) * (rng.random(n_c * m) < 0.8)
        selected = admissible.select(worth, past)
        assert selected.tobytes() in as_set(allowed)
        values = [worth @ p - charge(rules, p.reshape(n_c, m)) for p in allowed]
        value = worth @ selected - charge(rules, selected.reshape(n_c, m))
        if rules.dwell == 1:
            assert value == pytest.approx(max(values), rel=1e-12, abs=1e-12)
        else:
            assert -1e-12 <= value <= max(values) + 1e-12


@pytest.mark.parametrize("seed", seeds(120, quick=40))
def test_single_exchanges_lead_to_all_admissible_neighbours_at_their_price(seed):
    rules, n_c, m, _ = random_rules(seed)
    rng = np.random.default_rng([seed, 1])
    admissible, past = fitted(seed)
    patterns = admissible_patterns(seed)
    allowed = as_set(patterns)

    def price(pattern):
        return charge(rules, pattern.reshape(n_c, m))

    exchanges = PatternNeighbours(admissible, past)
    for pattern in patterns[rng.permutation(len(patterns))[:6]]:
        for i in np.flatnonzero(exchanges.pattern):
            exchanges.change(dropped=int(i))
        for i in np.flatnonzero(pattern):
            assert exchanges.additions()[i]
            exchanges.change(added=int(i))
        np.testing.assert_array_equal(exchanges.pattern, pattern)
        np.testing.assert_array_equal(exchanges.held, np.flatnonzero(pattern))
        additions, added_price = exchanges.additions(), exchanges.added_price()
        swaps, swapped_price = exchanges.swaps(), exchanges.swapped_price()
        dropped_price = exchanges.dropped_price()
        assert swaps.shape == (len(exchanges.held), n_c * m)
        for j in range(n_c * m):
            more = pattern.copy()
            more[j] = True
            assert additions[j] == (not pattern[j] and more.tobytes() in allowed)
            if additions[j]:
                assert added_price[j] == pytest.approx(price(more) - price(pattern), abs=1e-12)
        for row, i in enumerate(exchanges.held):
            less = pattern.copy()
            less[i] = False
            assert dropped_price[row] == pytest.approx(price(pattern) - price(less), abs=1e-12)
            for j in range(n_c * m):
                other = less.copy()
                other[j] = True
                assert swaps[row, j] == (not pattern[j] and other.tobytes() in allowed)
                if swaps[row, j]:
                    assert swapped_price[row, j] == pytest.approx(price(other) - price(pattern), abs=1e-12)


@pytest.mark.parametrize("counting", ["elementwise", "simultaneous"])
def test_past_moves_beyond_the_budget_leave_no_future_move(counting):
    rules = mampc.MoveRules(max_moves=2, sparsity_horizon=4, counting=counting)
    admissible = AdmissiblePatterns(rules, 2, 3)
    allowance = admissible.allowance(np.cumsum(np.ones((4, 2)), axis=0))  # three changes of both inputs
    assert allowance.exceeded
    assert allowance.left == 0
    assert not admissible.select(np.ones(6), allowance).any()
    assert not admissible.allows(np.eye(6, dtype=bool)[0], allowance)
    assert admissible.allows(np.zeros(6, dtype=bool), allowance)


def test_the_window_looks_back_on_one_change_fewer_than_its_length():
    admissible = AdmissiblePatterns(mampc.MoveRules(max_moves=2, sparsity_horizon=3), 1, 3)
    at = {change: np.where(np.arange(4) >= change, 1.0, 0.0)[:, None] for change in (1, 2, 3)}
    assert [admissible.allowance(at[change]).left for change in (1, 2, 3)] == [2, 1, 1]


def test_a_change_that_is_rounding_is_no_move():
    admissible = AdmissiblePatterns(mampc.MoveRules(max_moves=1, sparsity_horizon=3, dwell=3), 1, 2)
    assert admissible.allowance(np.array([[1.0], [1.0 + 5e-10], [1.0]])) == (1, (0,), False)
    assert admissible.allowance(np.array([[1.0], [1.0 + 5e-9], [1.0 + 5e-9]])) == (0, (1,), False)


@pytest.mark.parametrize(("age", "rest"), [(1, 3), (2, 2), (3, 1), (4, 0)])
def test_an_input_rests_for_what_is_left_of_its_dwell_time(age, rest):
    admissible = AdmissiblePatterns(mampc.MoveRules(dwell=4), 2, 6)
    inputs = np.zeros((6, 2))
    inputs[-age:, 0] = 1.0
    allowance = admissible.allowance(inputs)
    assert allowance.frozen == (rest, 0)
    first_open = admissible.open(allowance).reshape(6, 2).argmax(axis=0)
    assert first_open.tolist() == [rest, 0]


def test_without_rules_every_pattern_is_admissible_and_any_rule_restricts():
    assert AdmissiblePatterns(mampc.MoveRules(), 2, 3).unrestricted
    for rule in (
        {"max_moves": 1}, {"price": (0.0, 1.0)}, {"min_size": (0.0, 1.0)}, {"dwell": 2},
        {"max_moves_per_step": 1}, {"blocks": (2, 1)},
    ):  # fmt: skip
        assert not AdmissiblePatterns(mampc.MoveRules(**rule), 2, 3).unrestricted


def test_the_random_rules_bind_often():
    with_past = [moved(random_rules(seed)[3]).any() for seed in SEEDS]
    past = [fitted(seed)[1] for seed in SEEDS]
    assert sum(with_past) > 50
    assert sum(any(p.frozen) for p in past) > 20
    assert sum(p.exceeded for p in past) > 8
    assert sum(0 < len(admissible_patterns(seed)) - 1 < 60 for seed in SEEDS) > 50
