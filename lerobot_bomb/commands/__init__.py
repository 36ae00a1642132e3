"""``lerobot-bomb``: a file for each command."""
