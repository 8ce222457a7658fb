"""Points of a grid: features, clustering filter, density-uniform sampling."""
