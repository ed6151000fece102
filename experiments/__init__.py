"""Evaluation harness: scenarios in; tables, figures, reports and checks out."""
