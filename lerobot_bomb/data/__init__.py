"""Datasets: recording them with the scripted expert, converting published ones."""
