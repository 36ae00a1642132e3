"""LIBERO: where its files are."""
