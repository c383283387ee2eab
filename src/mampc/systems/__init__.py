"""Linear models and test signals."""
