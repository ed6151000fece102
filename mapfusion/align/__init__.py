"""Map alignment: pairs of landmarks, a method a file, and `Registration` around them."""
