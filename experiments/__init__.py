"""The harness: scenarios in, tables, figures and checks out."""
