"""Redraw the figures of the documentation, each from a computation: `make figures`."""

import tempfile
from pathlib import Path

import numpy as np
from scipy import signal
from ugly_export import ugly_export

import mampc
from mampc.base.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    legend_above,
    new_figure,
    styled,
)
from mampc.base.tolerances import SAME
from mampc.identification.export import inspect_export
from mampc.loop.hypotheses import HYPOTHESES
from mampc.report.figures import study_figures
from mampc.report.identifying import identify_and_write
from mampc.report.inspecting import inspection_figure
from mampc.study import load_study, run_study

IMAGES = Path(__file__).parent / "images"
EXAMPLES = Path(__file__).parents[1] / "examples"
SHOWN = {"noisy_overview", "noisy_moves-against-error"}
PALE = "#dce9f2"


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    save("procrastination", procrastination_figure())
    save("how-it-decides", loads_figure(deciding_runs()))
    for name, figure in example_figures().items():
        save(name, figure)
    for name, figure in export_figures().items():
        save(name, figure)
    result = run_study(load_study("quadruple-tank"), print)
    save("ranks", ranks_figure())
    save("resting-values", targets_figure())
    save("move-pattern", pattern_figure(result))
    for drawing in study_figures(result):
        if drawing.name in SHOWN:
            save(drawing.name, drawing.figure)


def example_figures():
    """An output and an input of studies in `examples/`, two controllers next to each other."""
    shown = {
        "reference-filter": ("noise-free", "MPC", "MPC with a ramp"),
        "on-off": ("noisy", "on/off", "six starts an hour"),
        "sticking-valves": ("sticking", "price", "compensated price"),
    }
    figures = {}
    for name, (scenario, *controllers) in shown.items():
        runs = run_study(load_study(EXAMPLES / f"{name}.toml"), print).runs[scenario]
        with styled():
            figure, axes = new_figure(2, 2, sharex=True, sharey="row")
            for (top, bottom), controller in zip(axes.T, controllers, strict=True):
                run = runs[controller]
                minutes = run.t / 60.0
                dashed(top, run, 0)
                top.plot(minutes, run.y[:, 0], color=BLUE, label="output")
                if not np.array_equal(run.position, run.u):
                    bottom.step(
                        minutes, run.position[:, 0], where="post", color=GREY, linewidth=2.2, label="valve"
                    )
                bottom.step(minutes, run.u[:, 0], where="post", color=VERMILION, label="input", linewidth=0.9)
                top.set_title(controller)
                bottom.set_xlabel("min")
            axes[0, 0].set_ylabel(run.names.outputs[0])
            axes[1, 0].set_ylabel(run.names.inputs[0])
            legend_above(figure)
        figures[name] = figure
    return figures


def dashed(panel, run, output):
    """The reference of an output over minutes."""
    look = {"color": BLACK, "linestyle": "--", "linewidth": 0.9, "label": "reference"}
    panel.step(run.t / 60, run.r[:, output], where="post", **look)


def ranks_figure():
    """Both levels of `examples/ranks.toml` with their limits, without and with ranks."""
    study = load_study(EXAMPLES / "ranks.toml")
    unranked = study.model_copy(update={"problem": study.problem.model_copy(update={"output_rank": None})})
    limits = (study.problem.limits.y_min[0], study.problem.limits.y_max[1])
    shown = (("no ranks", unranked), ("second level first", study))
    with styled():
        figure, axes = new_figure(2, 2, sharex=True, sharey="row")
        for column, (title, one) in zip(axes.T, shown, strict=True):
            run = run_study(one, print).runs["noise-free"]["MPC"]
            for i, panel in enumerate(column):
                panel.plot(run.t / 60, run.y[:, i], color=BLUE, label="level")
                dashed(panel, run, i)
                look = {"color": (VERMILION, ORANGE)[i], "label": ("at least", "at most")[i]}
                panel.axhline(limits[i], linestyle=":", linewidth=1.4, **look)
            column[0].set_title(title)
            column[1].set_xlabel("min")
        for panel, name in zip(axes[:, 0], run.names.outputs, strict=True):
            panel.set_ylabel(f"{name} level")
        legend_above(figure)
    return figure


def targets_figure():
    """The flow and both valves of `examples/resting-values.toml`, plain MPC and an exact price."""
    runs = run_study(load_study(EXAMPLES / "resting-values.toml"), print).runs["with a load"]
    with styled():
        figure, axes = new_figure(3, 2, sharex=True, sharey="row")
        for column, name in zip(axes.T, ("MPC", "price"), strict=True):
            run, minutes = runs[name], runs[name].t / 60
            column[0].plot(minutes, run.y[:, 0], color=BLUE, label="output")
            dashed(column[0], run, 0)
            for i, panel in enumerate(column[1:]):
                panel.step(minutes, run.u[:, i], where="post", color=VERMILION, label="input", linewidth=0.9)
            column[2].axhline(50.0, color=GREEN, linewidth=1.2, linestyle=":", label="resting value")
            column[0].set_title(name)
            column[2].set_xlabel("min")
        for panel, name in zip(axes[:, 0], (*run.names.outputs, *run.names.inputs), strict=True):
            panel.set_ylabel(name.replace("_", " "))
        legend_above(figure)
    return figure


def export_figures():
    """The ugly export of docs/data.md as `mampc inspect` draws it, and its model as `mampc show` does."""
    signals = {"inputs": ["PU-1.OP", "PU-2.OP"], "outputs": ["LI-1.PV", "LI-2.PV"]}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "export.csv"
        path.write_bytes(ugly_export().encode("cp1252"))
        columns = inspection_figure(inspect_export(path))
        model = identify_and_write(
            [path],
            path.with_suffix(".json"),
            print,
            reading=signals,
            settings={"feedthrough": False},
            share=2 / 3,
        ).model
    return {"export-columns": columns, "export-steps": model.plot()}


def save(name, figure):
    with styled():
        figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})


def pattern_figure(result):
    """One decision of the exact budget on the noisy tank: its pattern, and the inputs that come of it."""
    run = result.runs["noisy"]["exact budget"]
    rules = next(table.rules for table in result.study.controllers if table.name == "exact budget")
    back = rules.sparsity_horizon - 1
    made = np.abs(np.diff(run.u, axis=0, prepend=run.u_initial[None])) > SAME
    # The first decision with a move one sample behind it, one now and one later, none of them noise.
    k = next(
        k
        for k in range(back + 1, len(run.u))
        if made[k - 1].any()
        and made[k].any()
        and np.ptp(run.u[k - 2 : k + 1]) > 1
        and run.decisions[k].moves[1:].any()
    )
    decision, past = run.decisions[k], made[k - back : k]
    ahead = len(decision.moves)
    moved = np.vstack([past, decision.moves])
    with styled():
        figure, axes = new_figure(1 + run.u.shape[1], height=0.75, sharex=True)
        grid = axes[0, 0]
        kinds = {True: {True: ("moved", GREY), False: ("did not move", "white")},
                 False: {True: ("may move: part of the pattern", BLUE), False: ("may not move", PALE)}}  # fmt: skip
        for (row, i), move in np.ndenumerate(moved):
            sample = row - back
            name, colour = kinds[sample < 0][bool(move)]
            grid.bar(
                sample + 0.5,
                0.8,
                0.9,
                bottom=-i - 0.4,
                color=colour,
                edgecolor=GREY,
                linewidth=0.6,
                label=name,
            )
        grid.set_ylim(-moved.shape[1] + 0.4, 0.6)
        grid.set_yticks([0, -1], run.names.inputs)
        grid.set_title(
            f"{back} past and {ahead} future samples with {int(moved.sum())} moves; the budget is {rules.max_moves}"
        )
        grid.grid(False)
        edges = np.arange(-back, ahead + 1)
        for i, panel in enumerate(axes[1:, 0]):
            values = np.concatenate([run.u[k - back : k, i], decision.plan[:, i]])
            kept = np.append(values, values[-1])
            panel.step(edges[: back + 1], kept[[*range(back), back - 1]], where="post", color=GREY)
            panel.step(np.r_[0, edges[back:]], kept[back - 1 :], where="post", color=BLUE)
            panel.set_title(run.names.with_unit(run.names.inputs[i]))
            panel.margins(y=0.3)
        for panel in axes[:, 0]:
            panel.axvline(0, color=BLACK, linewidth=0.9, linestyle="--")
        axes[-1, 0].set_xticks(edges, ["now" if e == 0 else f"{e:+d}" for e in edges])
        axes[-1, 0].set_xlabel("sample, counted from now")
        axes[-1, 0].set_xlim(-back, ahead)
        legend_above(figure)
    return figure


def procrastination_figure(tail_horizon=20.0, plans=6, steps=32):
    """The plans of successive samples after a step of the reference, without a tail and with one."""
    plant = signal.StateSpace(signal.TransferFunction([-1.0, 1.0], [1.0, 2.0, 1.0])).to_discrete(0.25)
    model = mampc.StateSpace(plant.A, plant.B, plant.C, None, 0.25)
    with styled():
        figure, axes = new_figure(2, 2, height=1.6, sharex=True, sharey="row")
        for column, tail in zip(axes.T, (0.0, tail_horizon), strict=True):
            problem = mampc.TrackingProblem(
                model, prediction_horizon=8, control_horizon=8, move_weight=0.1, tail_horizon=tail
            )
            outputs, inputs, decisions = closed_loop(problem, mampc.MoveRules(price=1.0), steps)
            top, bottom = column
            for k, decision in enumerate(decisions[:plans]):
                size = np.abs(decision.plan).max() / 0.7
                plan, applied = decision.plan[:, 0] / size, np.array([0.0, *inputs[:k]]) / size
                top.axhline(-k, color="#d0d0d0", linewidth=0.6)
                top.step(
                    np.arange(-1, k + 1),
                    np.append(applied, applied[-1]) - k,
                    where="post",
                    color=GREY,
                    label="applied",
                )
                values = np.concatenate([applied[-1:], plan, plan[-1:]]) - k
                top.step(
                    np.r_[k, k : k + len(plan) + 1], values, where="post", color=BLUE, label="plan, output"
                )
                for j in np.flatnonzero(decision.moves[:, 0]):
                    top.plot(k + j, -k, "o", color=VERMILION, markersize=4, label="planned move")
            top.set_yticks(-np.arange(plans), [f"at {k}" for k in range(plans)])
            top.set_title(f"input as planned, {f'tail of {tail:g} samples' if tail else 'no tail'}")
            top.grid(False, axis="y")
            bottom.axhline(1.0, color=BLACK, linestyle="--", linewidth=0.9, label="reference")
            bottom.plot(np.arange(steps), outputs, color=BLUE)
            bottom.set_title("output")
            bottom.set_xlabel("sample")
            bottom.set_xlim(-1, plans + 10)
            bottom.set_xticks(range(0, plans + 11, 2))
        legend_above(figure)
    return figure


def deciding_runs(steps=240, seeds=range(8), most=1.25):
    """The tank under a load that jumps at sample 70 and wanders from 130 on.

    Every controller with the setting that moves least at up to `most` times plain MPC's error, on average of the seeds.
    """
    plant = mampc.plants.QuadrupleTank()
    model = mampc.linearise(plant).discretise(10.0)
    settings = {
        "prediction_horizon": 30, "output_weight": 1.0, "limits": mampc.Limits(u_min=0.0, u_max=100.0)
    }  # fmt: skip
    plain = mampc.MPC(mampc.TrackingProblem(model, control_horizon=5, move_weight=0.05, **settings))
    lighter = mampc.TrackingProblem(model, control_horizon=3, move_weight=0.005, tail_horizon=5.0, **settings)
    bank, usual = (
        mampc.LoadBank(model, noise=0.1),
        mampc.KalmanFilter.offset_free(model, measurement_noise=0.1),
    )

    def priced(price, estimator, counts):
        controller = mampc.MAMPC(lighter, mampc.MoveRules(price=price))
        return mampc.Regulator(controller, estimator, value_of_information=counts)

    kinds = {
        "plain MPC": (lambda size: mampc.Regulator(plain, usual), [0.0]),
        "MPC with a dead-band": (
            lambda size: mampc.Regulator(mampc.rivals.DeadBand(plain, size=size), usual), np.geomspace(0.2, 5, 14)
        ),
        "a price, one filter": (lambda price: priced(price, usual, False), np.geomspace(0.3, 20, 14)),
        "a price, load bank": (lambda price: priced(price, bank, False), np.geomspace(0.3, 20, 14)),
        "a price, load bank, later data": (lambda price: priced(price, bank, True), np.geomspace(0.3, 20, 14)),
    }  # fmt: skip
    rng, load = np.random.default_rng(5), np.zeros((steps, 2))
    load[70:] = [4.0, 0.0]
    load[130:] += np.cumsum(0.25 * rng.standard_normal((steps - 130, 2)), axis=0)
    reference = mampc.steps(steps, model.y_op, [(20, model.y_op + 2.0), (190, model.y_op)])
    given, base, found = {"noise": 0.1, "input_disturbance": load, "progress": False}, None, {}
    for name, (made, knobs) in kinds.items():
        best = None
        for knob in knobs:
            batch = mampc.simulate_batch(plant, made(knob), reference, seeds=seeds, **given)
            error = float(np.mean((batch.y - reference) ** 2))
            moves = float((np.abs(np.diff(batch.u, axis=1)) > SAME).sum(axis=(1, 2)).mean())
            base = error if base is None else base
            if error <= most * base and (best is None or moves < best[0]):
                best = moves, error / base, made(knob)
        print(f"{name:32} {best[0]:6.1f} moves of both pumps, error {best[1]:.2f}")
        found[name] = best[2], mampc.simulate(plant, best[2], reference, seed=1, **given)
    return found


def loads_figure(found):
    """One output, one input under two controllers, and what the load bank makes of the loads."""
    regulator, run = found["a price, load bank, later data"]
    rival = found["MPC with a dead-band"][1]
    names = [h.load.value.replace("_", " ") for h in HYPOTHESES]
    state, weights = regulator.initial_state(run.u_initial), []
    for y, reference in zip(run.y_measured, run.r, strict=True):
        state = regulator.step(state, y, reference).state
        weights.append(state.estimate.weights)
    weights = np.array(weights)
    colours = (GREY, SKY, BLUE, ORANGE, GREEN, VERMILION)
    samples = np.arange(len(run.t))
    with styled():
        figure, axes = new_figure(3, height=1.1, sharex=True)
        top, middle, bottom = axes[:, 0]
        top.plot(samples, run.y_measured[:, 0], color=GREY, linewidth=0.7, label="measured")
        top.plot(samples, run.y[:, 0], color=BLUE, label="with the load bank and later data")
        top.step(
            samples, run.r[:, 0], where="post", color=BLACK, linewidth=0.9, linestyle="--", label="reference"
        )
        top.set_title(run.names.with_unit(run.names.outputs[0]))
        middle.step(
            samples, rival.u[:, 0], where="post", color=VERMILION, linewidth=0.9, label="MPC with a dead-band"
        )
        middle.step(samples, run.u[:, 0], where="post", color=BLUE)
        middle.set_title(run.names.with_unit(run.names.inputs[0]))
        bottom.stackplot(samples, weights.T, colors=colours, labels=names, step="post", linewidth=0)
        bottom.set_ylim(0, 1)
        bottom.grid(False)
        bottom.set_title("how likely each hypothesis about the load is")
        bottom.set_xlabel("sample; the load jumps at 70 and wanders from 130 on")
        bottom.set_xlim(0, len(samples) - 1)
        legend_above(figure)
    return figure


def closed_loop(problem, rules, steps):
    """Outputs, inputs and decisions from rest, the reference being 1, with the plant as modelled."""
    model, controller = problem.model, mampc.MAMPC(problem, rules)
    state, x, outputs, decisions = controller.initial_state(), np.zeros(model.n_states), [], []
    for _ in range(steps):
        decisions.append(controller.step(state, x, [1.0]))
        state = decisions[-1].state
        outputs.append(float(model.C[0] @ x))
        x = model.A @ x + model.B @ decisions[-1].u
    return outputs, [float(d.u[0]) for d in decisions], decisions


if __name__ == "__main__":
    main()
