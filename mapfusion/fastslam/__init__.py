"""FastSLAM 1.0: M particles, each with one Kalman filter per landmark (eq. 1-10)."""
