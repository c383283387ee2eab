"""Several exports become one model."""

from pathlib import Path

import numpy as np
import pytest

from mampc import IOData, MampcError, Names
from mampc.report.identifying import like_the_others


def test_exports_of_one_plant_are_alike():
    def record(dt=10.0, unit="%"):
        return IOData(
            np.zeros((3, 1)), np.zeros((3, 1)), dt, Names(("u",), ("y",), units={"u": unit} if unit else {})
        )

    june = Path("june.csv")
    [added] = like_the_others(june, [record(unit="")], [record()])
    assert added.names == record().names
    with pytest.raises(MampcError, match=r"june\.csv: expected u in % as before, received m3/h"):
        like_the_others(june, [record(unit="m3/h")], [record()])
    with pytest.raises(MampcError, match=r"june\.csv: expected samples every 10 s as before, received 20 s"):
        like_the_others(june, [record(dt=20.0)], [record()])
