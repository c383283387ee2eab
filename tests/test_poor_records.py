"""Records that say too little: the least length, signals that stand still, inputs that excite too little."""

import sys

import numpy as np
import pytest

from mampc import IOData, MampcError, StateSpace, n4sid, prbs
from random_systems import noise_free, random_system
from seeds import deep, examples

WEIGHTINGS = ("cva", *deep("n4sid", "moesp"))


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize(("m", "l"), [(1, 1), (2, 2), (1, 3)])
def test_records_are_identified_from_a_least_length_on(m, l, weighting):
    rng = np.random.default_rng(0)
    least = 4 * (m + l + 1) - 1
    for samples in (1, least - 1, *range(least, least + 20, examples(1, quick=5))):
        data = IOData(rng.standard_normal((samples, m)), rng.standard_normal((samples, l)), 1.0)
        if samples < least:
            with pytest.raises(MampcError, match=f"expected at least {least} samples"):
                n4sid(data, weighting=weighting)
        else:
            assert np.isfinite(n4sid(data, weighting=weighting).model.A).all()


@pytest.mark.parametrize(("count", "samples"), [(40, 15), (30, 11), (60, 20)])
def test_many_short_records_give_a_model(count, samples):
    """As exports with many gaps have them; each is shorter than the longest past that is looked at."""
    rng, records, plant = np.random.default_rng(0), [], StateSpace([[0.8]], [[1.0]], [[1.0]], None, 1.0)
    for _ in range(count):
        u = rng.choice([-1.0, 1.0], (samples, 1))
        records.append(IOData(u, plant.response(u) + 0.01 * rng.standard_normal((samples, 1)), 1.0))
    assert n4sid(records).model.dc_gain() == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("constant", ["u1", "u2", "y1", "y2"])
def test_a_constant_signal_is_refused_by_name(constant, weighting):
    signals = dict(
        zip(("u1", "u2", "y1", "y2"), np.random.default_rng(0).standard_normal((4, 300)), strict=True)
    )
    signals[constant] = np.full(300, 0.1)
    data = IOData(
        np.stack([signals["u1"], signals["u2"]], 1), np.stack([signals["y1"], signals["y2"]], 1), 1.0
    )
    with pytest.raises(MampcError, match=f"expected signals that vary, received constant {constant}"):
        n4sid(data, weighting=weighting)


@pytest.mark.parametrize(
    "u", [np.tile(prbs(order=3), (60, 1)), np.sin(0.1 * np.arange(400)), np.repeat(prbs(order=8), 2, axis=1)]
)
def test_inputs_that_excite_too_little_are_refused(u):
    y = np.random.default_rng(0).standard_normal(len(u))
    with pytest.raises(MampcError, match="expected inputs that excite"):
        n4sid(IOData(u, y, 1.0))


def test_what_cannot_be_computed_is_told_in_words(monkeypatch):
    def fails(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(sys.modules["mampc.identification.n4sid"], "estimated", fails)
    with pytest.raises(
        MampcError, match=r"n4sid: expected records that a model .*Singular matrix; look for inputs"
    ):
        n4sid(noise_free(random_system(0, 2, 1, 1, False), 0))
