"""Seeing BOMB: one episode as a recording and a video, every perturbation axis as an image."""
