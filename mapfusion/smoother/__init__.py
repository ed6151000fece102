"""Batch smoother: one robot's whole log at once, its path and landmarks with all correlations.

In come a log, which landmark each observation is of, and a first guess of the path (FastSLAM gives
both); out go the most probable path and landmarks, and the joint covariance of the landmarks.
"""
