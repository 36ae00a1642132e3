"""Base classes and parts that our policies share."""
