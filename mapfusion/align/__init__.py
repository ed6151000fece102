"""Map alignment: correspondences, one estimator a file, a common local refinement."""
