"""Visual landmarks: Harris corners, U-SURF descriptors, stereo, tracking."""
