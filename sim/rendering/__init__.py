"""Ray caster for painted worlds, and the frame source of all renderers.

A pixel column of a level camera is a wedge in plan and shows the nearest wall over its whole height
(`walls`), the ceiling above and the floor below (`floor_and_ceiling`), and other robots in front
(`robots`). `ray_caster` combines them; `frame_source` renders any frame of a simulation.
"""
