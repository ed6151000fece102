"""Alignment methods by name, whoever wrote them: names in, aligners out, each called safely.

Our own are called in place, others' in a process of their own.
"""
