"""The perturbation axes, one file each, which `lerobot_bomb.pusht.perturbations` lists."""
