"""Datasets: recording them with the scripted expert."""
