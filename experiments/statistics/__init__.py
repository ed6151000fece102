"""What several runs say together, and how sure one can be of it."""
