"""Map alignment: correspondences, one module per aligner, and least-squares refinement."""
