"""Two versions of the same runs in, what got better or worse out."""
