"""Scenarios in, finished stages out: what a stage is, the store, tasks, and who does them."""
