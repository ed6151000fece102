"""The stages of a run, one a file, each kept under its key (see `experiments.store`)."""
