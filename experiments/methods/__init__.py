"""Alignment methods by name: names in, aligners out, our own in place, others' in a process."""
