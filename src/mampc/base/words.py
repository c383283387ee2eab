"""Every word that a decision may say, with the sentence that explains it: statuses, remarks, faults of sensors."""

from __future__ import annotations

from enum import StrEnum
from typing import Self


class Sentence(StrEnum):
    """A word with a `sentence` that says it at length; members are written as `NAME = word, sentence`."""

    sentence: str

    def __new__(cls, value: str, sentence: str) -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.sentence = sentence
        return member


class Status(Sentence):
    """How a decision came about; `status.sentence` says it in words."""

    OPTIMAL = "optimal", "The plan is proven to be the best one."
    FEASIBLE = (
        "feasible",
        "The plan keeps every limit and rule as far as the past allows; a better one may exist.",
    )
    SETTLED = "settled", "The method settled; moves off its pattern are small, not zero (see polish)."
    WARM_UP = "warm_up", "Plain MPC, while the sparse method waits for its first past inputs."
    ITERATION_LIMIT = "iteration_limit", "The method stopped at its iteration cap before it settled."
    TIME_LIMIT = "time_limit", "The method stopped at its time limit with the best plan so far."
    HELD_INFEASIBLE = "held_infeasible", "No plan keeps the limits: the previous inputs are held."
    HELD_BAD_MEASUREMENT = (
        "held_bad_measurement",
        "A state, measurement or reference was not a usable number: the previous inputs are held.",
    )
    HELD_SOLVER_FAILED = (
        "held_solver_failed",
        "The solver failed or ran out of time: the previous inputs are held.",
    )

    @property
    def held(self) -> bool:
        """Whether nothing could be planned, so that the previous inputs are held."""
        return self in (Status.HELD_INFEASIBLE, Status.HELD_BAD_MEASUREMENT, Status.HELD_SOLVER_FAILED)


class Remark(Sentence):
    """What else there is to say about a decision; `remark.sentence` says it in words."""

    BUDGET_EXCEEDED = (
        "budget_exceeded",
        "The moves already made exceed the budget of their window: no further move is planned.",
    )
    BACK_INSIDE = (
        "back_inside",
        "The applied inputs were outside their limits, or off their levels, and go back.",
    )
    ROUNDING = (
        "rounding",
        "The prediction enlarges rounding so much that the optimum is known no better than to within the gap.",
    )
    RULES_SUSPENDED = (
        "rules_suspended",
        "The move rules were suspended: under them an output would leave its limits by more than the margin.",
    )
    GAINS_CORRECTED = (
        "gains_corrected",
        "The gains of the model were corrected, since these predict better: from the next sample on they decide.",
    )


class Fault(Sentence):
    """Why a measurement was ignored; `fault.sentence` says it in words."""

    MISSING = "missing", "No usable number came."
    OUT_OF_RANGE = "out_of_range", "The value is outside what the sensor can show."
    JUMP = "jump", "The value is too far from its prediction to be believed at once."
    STUCK = "stuck", "The value stays the same to the last bit although the output must have moved."


class LoadKind(Sentence):
    """What unmeasured loads seem to do; `load.sentence` says it in words."""

    STEADY = "steady", "Loads hardly change."
    WANDERS = "wanders", "Loads wander by about a third of the measurement noise a sample."
    WANDERS_FAR = "wanders_far", "Loads wander by about the measurement noise a sample."
    DIES_AWAY = "dies_away", "Loads come and die away by themselves within some ten samples."
    DRIFTS = "drifts", "Loads go on in one direction for some thirty samples."
    JUMPS = "jumps", "A load has just jumped."
