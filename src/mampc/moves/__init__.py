"""Move rules, the patterns they admit, and the program on one pattern."""
