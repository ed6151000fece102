"""Studies over many runs: sweeps, statistics, comparisons, refusal, benchmark."""
