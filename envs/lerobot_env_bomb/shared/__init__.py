"""Parts that our environments on MuJoCo share: the choice of an OpenGL backend, and rotations."""
