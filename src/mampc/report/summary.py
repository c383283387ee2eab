"""A study's result as numbers: what summary.json holds and the tables show."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.loop.run import Run
from mampc.study import Study, StudyResult
from mampc.study.wear import Ratings, ratings_of


def summarise(result: StudyResult) -> dict[str, Any]:
    """The content of summary.json: plain numbers, lists and text, no number that JSON cannot hold."""
    study, model, identified = result.study, result.model, result.identified
    ratings = ratings_of(study, model.n_inputs)
    return {
        "study": study.name,
        "steps": study.steps,
        "dt": study.dt,
        "warnings": list(result.warnings),
        "model": {
            "order": model.n_states,
            "inputs": list(model.names.inputs),
            "outputs": list(model.names.outputs),
            "largest_pole": float(np.abs(model.poles()).max()),
            "fit_percent": None if identified is None else [round(float(fit), 3) for fit in identified.fit],
        },
        "scenarios": [
            {
                "name": scenario.name,
                "noise": scenario.noise,
                "seed": scenario.seed,
                "controllers": [
                    {
                        "name": table.name,
                        "counts_on_later_data": result.made[table.name].counts_on_later_data,
                        "largest_offset": _known(result.made[table.name].largest_offset),
                        **_controller(result.runs[scenario.name][table.name], study, ratings),
                    }
                    for table in study.controllers
                ],
            }
            for scenario in study.scenarios
        ],
    }


def _controller(run: Run, study: Study, ratings: Ratings) -> dict[str, Any]:
    microseconds = run.solve_times * 1e6
    return {
        "estimator": "load_bank" if run.decisions and run.decisions[0].load is not None else "kalman_filter",
        **_metrics(run, study, 0, ratings),
        "without_transient": {"skipped": study.skip, **_metrics(run, study, study.skip, ratings)},
        "solve_time_us": {
            "median": float(np.median(microseconds)),
            "p99": float(np.percentile(microseconds, 99)),
            "max": float(microseconds.max()),
        },
        "status": run.statuses,
        "gap": _gap(run.gaps),
        "plant_faults": dict(Counter(fault for faults in run.faults.values() for fault in faults)),
    }


def _known(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _gap(gaps: Array) -> dict[str, float | None]:
    """How many decisions are proven best, and how far the others may be from that, where a bound is known."""
    bounded = gaps[np.isfinite(gaps)]
    return {
        "proven": float((gaps == 0).mean()),
        "bounded": len(bounded) / len(gaps),
        "median": float(np.median(bounded)) if len(bounded) else None,
        "max": float(bounded.max()) if len(bounded) else None,
    }


def _metrics(run: Run, study: Study, skip: int, ratings: Ratings) -> dict[str, Any]:
    metrics = run.metrics(
        threshold=study.threshold, skip=skip, dead_band=ratings.dead_band, output_weight=study.error_weight
    )
    return {
        "sparse_density": {
            "threshold": metrics.threshold,
            "per_input": metrics.sparse_density.tolist(),
            "exact_per_input": metrics.exact_density.tolist(),
        },
        "tracking_error": metrics.tracking_error,
        "weighted_error": metrics.weighted_error,
        "time_outside_per_output": _known(metrics.time_outside),
        "mean_distance_outside_per_output": _known(metrics.mean_distance_outside),
        "travel_per_input": metrics.travel.tolist(),
        "moves": int(metrics.moves.sum()),
        "moves_per_input": metrics.moves.tolist(),
        "reversals_per_input": metrics.reversals.tolist(),
        "mean_hold_time_per_input": metrics.mean_hold_time.tolist(),
        "median_hold_time_per_input": metrics.median_hold_time.tolist(),
        "longest_hold_time_per_input": metrics.longest_hold_time.tolist(),
        "dead_band_per_input": metrics.dead_band.tolist(),
        "starts_per_input": metrics.starts.tolist(),
        "starts_per_hour_per_input": metrics.starts_per_hour.tolist(),
        "share_of_rated_starts_per_input": ratings.load(metrics.starts_per_hour),
        "life_years_per_input": ratings.life_years(metrics.starts_per_hour),
    }
