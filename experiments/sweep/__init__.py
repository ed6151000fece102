"""Many runs at once: scenarios, seeds and values, shared out to processes or to a cluster."""
