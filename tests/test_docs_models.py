"""docs/models.md: its Python runs, and does what the page says."""

from pathlib import Path

import numpy as np

PAGE = (Path(__file__).parents[1] / "docs" / "models.md").read_text()


def test_the_python_of_the_page_runs():
    scope = {}
    for block in PAGE.split("```python")[1:]:
        exec(block.split("```")[0], scope)
    np.testing.assert_allclose(scope["column"].dc_gain(), [[12.8, -18.9], [6.6, -19.4]])
    assert scope["error"].max() <= 0.01
    assert scope["found"].accepted
    off = scope["plant"].dc_gain() / scope["column"].dc_gain()
    assert (
        np.abs(scope["corrected"].dc_gain() / scope["plant"].dc_gain() - 1).max()
        < np.abs(1 / off - 1).max() / 2
    )
