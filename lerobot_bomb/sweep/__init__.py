"""Many evaluations as one job that can be killed, split and gone on with."""
