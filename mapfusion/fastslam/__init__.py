"""FastSLAM: one robot, M particles, a Kalman filter per particle and landmark (eq. 1-10)."""
