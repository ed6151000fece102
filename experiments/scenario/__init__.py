"""Scenarios: YAML files, validated settings, generated worlds, the suite."""
