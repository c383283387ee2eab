"""Redraw the figures of the documentation from a run of the built-in study: `make figures`."""

from pathlib import Path

from mampc.loop.drawing import styled
from mampc.report.figures import study_figures
from mampc.study import load_study, run_study

IMAGES = Path(__file__).parent / "images"
SHOWN = {"noisy_u1", "noisy_y1", "noisy_moves-against-error"}


def main() -> None:
    result = run_study(load_study("quadruple-tank"), print)
    IMAGES.mkdir(exist_ok=True)
    for name, figure in study_figures(result):
        if name in SHOWN:
            with styled():
                figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
