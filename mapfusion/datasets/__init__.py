"""Datasets: importers and exporters, one module per format, listed in `formats.py`."""
