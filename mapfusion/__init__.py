"""Landmark maps of independent robots: built by FastSLAM, aligned, merged.

Frames are right-handed: x forward, y left, z up; metres, radians, seconds.
`T_a_b` maps points given in frame b into frame a.
"""
