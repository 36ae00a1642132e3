"""The benchmark: board, episodes, observations, perturbations, the expert."""
