"""Scenario files in, validated values out: settings, generated worlds, the suite."""
