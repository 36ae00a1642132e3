"""LIBERO with perturbations (`bomb_libero`): axes, episodes, why they fail; numpy only, no simulator."""
