"""Studies side by side: sweeps over settings."""
