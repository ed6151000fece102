"""Any number of robots: which of the alignments of their maps can be true together."""
