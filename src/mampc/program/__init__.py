"""The tracking problem and its condensed quadratic program."""
