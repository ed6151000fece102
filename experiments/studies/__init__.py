"""Many runs in, summaries out: sweeps, statistics, comparisons, refusal, the benchmark."""
