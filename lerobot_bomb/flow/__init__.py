"""Flow matching from noise to actions along a straight path, by a velocity head, a noise head or both."""
