"""What every other folder stands on: errors, checks, names, files, words, tolerances."""
