"""The lowest floor: alignment methods by name, whoever wrote them.

In come a name and parameters; out goes something that aligns two maps, here or in a process of its
own, and cannot end a run.
"""
