"""Finished stages and the truth in, judged tables out: what is right is decided here alone."""
