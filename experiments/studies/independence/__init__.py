"""Costs of independence: maps fused from independent robots, against one smoother over all logs."""
