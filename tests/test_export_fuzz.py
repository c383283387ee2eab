"""Generated exports with known truth: what is read is true, complete and split where it has to be, or refused."""

import numpy as np
import pytest

import mampc
from exports import ugly_export
from seeds import seeds

NAMES = {"inputs": ["FIC-1.OP", "FIC-2.OP"], "outputs": ["TI 3"]}


def runs(good):
    """First and last-plus-one sample of every run of good samples of two or more."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(int)))
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]


def read_and_compare(seed, path):
    """Whether an export was read, and it is the truth; False where it was refused."""
    ugly = ugly_export(seed)
    path.write_bytes(ugly.content)
    try:
        export = mampc.read_export(path, **NAMES)
    except mampc.MampcError:
        return False
    expected = runs(ugly.good)
    assert len(export.records) == len(expected), (ugly.features, export.notes)
    for record, (a, b) in zip(export.records, expected, strict=True):
        assert record.dt == ugly.dt
        np.testing.assert_allclose(record.u, ugly.u[a:b], rtol=1e-12, err_msg=str(ugly.features))
        np.testing.assert_allclose(record.y, ugly.y[a:b], rtol=1e-12, err_msg=str(ugly.features))
    return True


@pytest.mark.parametrize("block", seeds(120, quick=1))
def test_what_is_read_is_true_and_most_is_read(block, tmp_path):
    read = [read_and_compare(seed, tmp_path / "export.csv") for seed in range(20 * block, 20 * block + 20)]
    assert np.mean(read) > 0.8
