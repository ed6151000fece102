"""Alignment methods by name: discovery of plug-ins, and isolated processes that run them."""
