"""The perturbation axes, one file each, which `lerobot_bomb.bomb.perturbations` lists."""
