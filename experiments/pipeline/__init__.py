"""Pipeline: stages of a scenario, their store, and the workers that run them."""
