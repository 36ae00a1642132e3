"""What our policies share."""
