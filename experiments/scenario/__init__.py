"""Scenarios: settings, validation, generated worlds and the suite."""
