"""The perturbation axes, one file each, which `lerobot_bomb.libero.perturbations` lists."""
