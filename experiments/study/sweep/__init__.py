"""All combinations of settings and seeds, on all cores or a cluster."""
