"""What independence costs: maps made alone and fused, beside one smoother over all logs."""
