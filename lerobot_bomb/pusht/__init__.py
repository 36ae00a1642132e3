"""PushT with perturbations (`bomb_pusht`): axes, episodes, why they fail; numpy only, no simulator."""
