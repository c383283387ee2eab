"""Every tolerance that decides what a move is, and the order they need.

Lengths are absolute, in input units: an actuator's resolution does not depend on where it stands.
"""

SAME = 1e-9  # inputs nearer than this are the same, so that rounding is no move
KEPT = 1e-9  # an input that does not move keeps limits up to rounding
INSIDE = 1e-9  # a distance to a limit that no rounding can make up
ROUNDING = 1e-8  # a smaller planned move may be none
NOTHING = 1e-11  # a smaller planned move is none, and the others need not make up for it
SMALLER = 1e-8  # a move that falls short of its least size by no more is rounded up to it
URGENT = 1e-6  # output units: what suspending the rules has to gain at least
TIE = 1e-10  # of the optimum: plans nearer than this are equally good

# What is dropped at once is no move, and every move is looked at before it counts.
assert NOTHING < SAME <= ROUNDING
# An input that goes back to its limit by no more has not moved.
assert max(KEPT, INSIDE) <= SAME
# A move rounded up to its least size is one.
assert SAME < SMALLER < URGENT


def tie(objective: float, rounding: float = 0.0) -> float:
    """How near two objectives are that are equally good: TIE, or what rounding leaves open.

    Args:
        objective: a sum of squares, not negative.
        rounding: of the length whose square it is.
    """
    return TIE * objective + (2 * objective**0.5 + rounding) * rounding if objective < float("inf") else 0.0
