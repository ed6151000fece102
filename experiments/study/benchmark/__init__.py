"""Every method on made-up pairs of maps: success, error and time."""
