"""Batch smoother: maximum a posteriori path and landmarks of a whole log.

Input: a log, the landmark of each observation and an initial path (from FastSLAM). Output: path,
landmarks and the joint covariance of the landmarks.
"""
