"""A checkpoint's folder: its names, checks, config, processors, adapters and identity."""
