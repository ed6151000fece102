"""Evaluation: finished stages and the truth in, tables of errors out."""
